"""Let Gmsh load on machines without display libraries.

Gmsh's shared library is linked to those of its window (X11, OpenGL, fontconfig), which servers and containers often
lack. The training package uses Gmsh without a window, where none of them is called. For each that this machine lacks,
this puts an empty library of that name into the environment; for those it has, it puts none.
"""

import ctypes
import os
import subprocess
import sys
from pathlib import Path

# Name of the library, and the functions of it whose addresses Gmsh wants when it is loaded.
LIBRARIES: dict[str, tuple[str, ...]] = {
    "libGL.so.1": (),
    "libGLU.so.1": (),
    "libX11.so.6": ("XDrawArc", "XFillArc"),
    "libXcursor.so.1": (),
    "libXext.so.6": (),
    "libXfixes.so.3": (),
    "libXft.so.2": (),
    "libXinerama.so.1": (),
    "libXrender.so.1": (),
    "libfontconfig.so.1": (),
}


def is_missing(name: str) -> bool:
    """Whether the loader finds no library of this name."""
    try:
        ctypes.CDLL(name)
    except OSError:
        return True
    return False


def stand_in(folder: Path, name: str, functions: tuple[str, ...]) -> None:
    """Build a library of this name whose functions end the process when they are called."""
    source = "#include <cstdlib>\n" + "".join(
        f'extern "C" void {function}() {{ std::abort(); }}\n' for function in functions
    )
    compiler = os.environ.get("CXX", "c++")
    command = [
        compiler,
        "-shared",
        "-fPIC",
        "-x",
        "c++",
        "-",
        f"-Wl,-soname,{name}",
        "-o",
        str(folder / name),
    ]
    subprocess.run(command, input=source, text=True, check=True)


def main() -> int:
    """Renew the stand-ins of the running interpreter's environment."""
    folder = Path(sys.prefix) / "lib"
    # The environment's own folder comes first in the search: earlier stand-ins would look like the real ones.
    for name in LIBRARIES:
        (folder / name).unlink(missing_ok=True)
    missing = [name for name in LIBRARIES if is_missing(name)]
    for name in missing:
        stand_in(folder, name, LIBRARIES[name])
    if missing:
        print(f"Gmsh will do without its window: empty libraries stand in for {', '.join(missing)}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
