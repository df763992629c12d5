"""The page of licences names what is installed at run time: packages, bundled libraries, copyleft parts."""

import re
import subprocess
import sys
from importlib.metadata import distribution, version

import pytest

from installed_packages import ROOT, RUN_TIME, VIEWER, named, needed
from scripts.loading import load_script
from test_dependencies import CORE, TRAINING, imports

pytestmark = pytest.mark.skipif(
    not version("torch").endswith("+cpu"), reason="the page's tables are those of PyTorch's CPU build"
)
licences = load_script("licences")
PAGE = (ROOT / "docs" / "reference" / "licences.md").read_text(encoding="utf-8")
INSTALLED = sorted(needed([need for file in (*RUN_TIME, VIEWER) for need in named(file)]))
# Their texts begin so; the licences of Python and of Mozilla, and choices between licences, only mention them.
GPL_TEXT = re.compile(r"GNU (?:LESSER |LIBRARY |AFFERO )?GENERAL PUBLIC LICENSE\s+Version \d", re.IGNORECASE)
LICENCE_FILE = re.compile(r"(licen[cs]e|copying|gpl|third-party)[^/]*$", re.IGNORECASE)


def section(heading: str) -> str:
    return re.split(r"^## ", PAGE.partition(f"\n## {heading}\n")[2], maxsplit=1, flags=re.MULTILINE)[0]


def bundled(name: str) -> set[str]:
    """Libraries that a package brings along in a folder of its own, without hashes and versions."""
    files = [str(file) for file in distribution(name).files or []]
    found = [file for file in files if re.search(r"\.libs/|^torch/lib/", file) and ".so" in file]
    return {re.sub(r"(-[0-9a-f]{8})*(\.\d+)*\.so.*", "", file.rpartition("/")[2]) for file in found}


def brings_gpl_text(name: str) -> bool:
    files = [file for file in distribution(name).files or [] if LICENCE_FILE.search(str(file))]
    texts = [
        file.locate().read_text(encoding="utf-8", errors="replace")
        for file in files
        if ".py" not in file.name
    ]
    return any(GPL_TEXT.search(text) for text in texts)


def test_tables_are_those_of_what_is_installed():
    assert len(INSTALLED) > 100
    assert licences.page(PAGE) == PAGE, "run scripts/licences.py"


def test_package_that_comes_in_is_missed():
    without = PAGE.replace(", safetensors", "")
    assert without != PAGE and licences.page(without) == PAGE


def test_every_bundled_library_is_named():
    found = {library for name in INSTALLED for library in bundled(name)}
    assert {"libgmp", "libcrypto", "libscipy_openblas", "libtorch_cpu"} <= found
    assert sorted(found - set(re.findall(r"`(lib[\w-]+)`", section("Libraries inside the wheels")))) == []


def test_no_library_is_named_that_is_gone():
    named_there = set(re.findall(r"`(lib[\w-]+)`", section("Libraries inside the wheels")))
    assert sorted(named_there - {library for name in INSTALLED for library in bundled(name)}) == []


@pytest.mark.parametrize("name", [name for name in INSTALLED if brings_gpl_text(name)])
def test_package_with_the_text_of_a_gpl_is_explained(name):
    assert re.search(rf"\| {re.escape(name)}(,| \|)|, {re.escape(name)}(,| \|)", section("Copyleft"))


def test_texts_of_gpls_are_found():
    assert brings_gpl_text("libigl") and not brings_gpl_text("typing-extensions")


def test_nothing_imports_what_is_under_a_strong_copyleft():
    sources = [*CORE.rglob("*.py"), *TRAINING.rglob("*.py")]
    imported = {name for source in sources for name in imports(source)}
    assert "igl" in imported
    assert [
        name for name in sorted(imported) if re.match(r"igl\.(copyleft|triangle|embree|cycodebase)", name)
    ] == []


def test_estimator_loads_nothing_that_the_page_says_it_does_not():
    """All libraries that the core imports, and VTK's readers, in one process: what lies in its memory."""
    script = """
import fast_simplification, igl, matplotlib.pyplot, scipy.sparse.linalg, scipy.spatial, torch
import softtissue_estimator.organ.organ, softtissue_estimator.registration.rigid_icp
import vtkmodules.vtkIOLegacy, vtkmodules.vtkIOXML
print(open("/proc/self/maps").read())
"""
    environment = {"PYTHONPATH": str(CORE.parent), "PATH": "", "HOME": "/nonexistent", "MPLBACKEND": "agg"}
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    files = set(re.findall(r"/\S+\.so\S*", done.stdout))
    assert any("pyigl_core" in file for file in files) and any("libvtkIOXML" in file for file in files)
    assert [file for file in files if re.search(r"copyleft|triangle|tetgen|cgal|embree|gl2ps", file)] == []
