"""Read a mesh file with VTK or meshio and write its arrays to an NPZ file: a program of its own, run by `isolated`.

These libraries take what a damaged file says for true: they may end the process or ask for any amount of memory. With
exit code 3, the last line on stderr says why the file cannot be read.
"""

from __future__ import annotations

import re
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np

UNREADABLE = 3
_LEAST_MEMORY_BYTES = (
    3 << 30
)  # of addresses, of which libraries take one; beside a multiple of the file's size
_MEMORY_BYTES_PER_FILE_BYTE = 20
_MSH_SECTION = re.compile(rb"^\$(?!End)(\w+)[ \t]*\r?$", re.MULTILINE)
_MSH_GEOMETRY = (b"MeshFormat", b"Nodes", b"Elements")


class _UnreadableError(Exception):
    """Its text is one line for the user."""


def main() -> int:
    """Read the file `sys.argv[1]`, of the format `sys.argv[2]`, and write arrays to `sys.argv[3]`."""
    import resource  # of POSIX

    source, kind, target = sys.argv[1:]
    limit = _LEAST_MEMORY_BYTES + _MEMORY_BYTES_PER_FILE_BYTE * Path(source).stat().st_size
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(
        resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard)
    )
    try:
        arrays = _read_msh(source) if kind == ".msh" else _read_vtk(source, kind)
        np.savez(target, **arrays)
    except _UnreadableError as error:
        print(error, file=sys.stderr)
        return UNREADABLE
    except MemoryError:
        print(
            f"it needs more than the {limit / 2**30:.1f} GiB of memory that reading may take", file=sys.stderr
        )
        return UNREADABLE
    return 0


def _read_vtk(source: str, kind: str) -> dict[str, Any]:
    """Points; types, offsets and nodes of the cells as VTK keeps them, which may be anything."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkCommonDataModel import vtkPolyData, vtkUnstructuredGrid

    to_numpy: Any = vtk_to_numpy
    reader = _vtk_reader(kind)
    # VTK prints errors instead of raising them.
    capture = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(capture)
    reader.SetFileName(source)
    if kind != ".vtk":
        # Geometry alone is wanted; data of points and cells may be of any size.
        reader.UpdateInformation()
        reader.GetPointDataArraySelection().DisableAllArrays()
        reader.GetCellDataArraySelection().DisableAllArrays()
    reader.Update()
    data = reader.GetOutput()
    printed = capture.GetOutput()
    # Damaged names in a file make what VTK prints no text.
    text = printed if isinstance(printed, str) else printed.decode(errors="replace")
    if "ERR" in text.upper():
        raise _UnreadableError("damaged or cut off")
    if not isinstance(data, vtkPolyData | vtkUnstructuredGrid):
        what = "nothing" if data is None else data.GetClassName().removeprefix("vtk")
        raise _UnreadableError(f"it holds {what}")
    if data.GetPoints() is None or data.GetNumberOfPoints() == 0:
        raise _UnreadableError("it holds no points")
    cells: list[tuple[Any, Any]]
    if isinstance(data, vtkPolyData):
        if data.GetPolys().GetMaxCellSize() > 4:
            data = _cut_into_triangles(data)
        parts = [(7, data.GetPolys()), (6, data.GetStrips()), (4, data.GetLines()), (1, data.GetVerts())]
        cells = [(np.full(part.GetNumberOfCells(), number), part) for number, part in parts]
    else:
        cells = [(to_numpy(_cell_types(data)), data.GetCells())]
    arrays = {"points": to_numpy(data.GetPoints().GetData()), "header": np.array(_header(reader, data))}
    for i, (types, part) in enumerate(cells):
        if part is not None and part.GetNumberOfCells() > 0:
            arrays[f"types{i}"] = types
            arrays[f"offsets{i}"] = to_numpy(part.GetOffsetsArray())
            arrays[f"nodes{i}"] = to_numpy(part.GetConnectivityArray())
    return arrays


def _header(reader: Any, data: Any) -> str:
    """Return the title of a legacy file and the text arrays that belong to the whole, one a line."""
    lines = [f"title: {reader.GetHeader() or ''}"] if hasattr(reader, "GetHeader") else []
    fields = data.GetFieldData()
    for i in range(fields.GetNumberOfArrays()):
        array: Any = fields.GetAbstractArray(i)
        if array.IsA("vtkStringArray") and array.GetNumberOfValues() == 1:
            lines.append(f"{array.GetName()}={array.GetValue(0)}")
    # Damaged text need not be UTF-8.
    return "\n".join(lines).encode(errors="replace").decode(errors="replace")


def _vtk_reader(kind: str) -> Any:
    # Each of the modules takes a while to import.
    if kind == ".vtk":
        from vtkmodules.vtkIOLegacy import vtkDataSetReader

        return vtkDataSetReader()
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    return vtkXMLPolyDataReader() if kind == ".vtp" else vtkXMLUnstructuredGridReader()


def _cut_into_triangles(surface: Any) -> Any:
    """Cut polygons that may not be convex; points keep their numbers."""
    from vtkmodules.vtkFiltersCore import vtkTriangleFilter

    cut: Any = vtkTriangleFilter()
    cut.PassLinesOff()
    cut.PassVertsOff()
    cut.SetInputData(surface)
    cut.Update()
    return cut.GetOutput()


def _cell_types(grid: Any) -> Any:
    try:
        return grid.GetCellTypes()
    except TypeError:  # VTK before 9.6
        return grid.GetCellTypesArray()


class _Geometry:
    """In the place of meshio's Mesh, which refuses data of cells that do not fit all of them."""

    def __init__(self, points: Any, cells: Any, **_beside: Any) -> None:
        self.points, self.cells = points, cells


def _read_msh(source: str) -> dict[str, Any]:
    """Points; kind and nodes of each block of cells."""
    import meshio.gmsh
    from meshio.gmsh import _gmsh22, _gmsh41

    for version in (_gmsh22, _gmsh41):
        version.Mesh = _Geometry
    # numpy warns of numbers that end too early; what is missing then shows in the shapes.
    warnings.simplefilter("ignore")
    try:
        with tempfile.TemporaryFile() as file:
            file.write(_geometry_alone(Path(source).read_bytes()))
            file.seek(0)
            # meshio's own `read` ends the program if it cannot read a file.
            mesh = meshio.gmsh.main.read_buffer(file)
        arrays: dict[str, Any] = {"points": np.asarray(mesh.points, dtype=np.float64)}
        for i, (kind, nodes) in enumerate(map(_kind_and_nodes, mesh.cells)):
            arrays[f"kind{i}"] = np.array(kind)
            arrays[f"nodes{i}"] = np.asarray(nodes, dtype=np.int64)
    except MemoryError:
        raise
    except Exception as error:
        # It raises whatever it stumbles over in damaged files: ReadError, ValueError, IndexError, KeyError, ...
        raise _UnreadableError(
            f"damaged or cut off ({' '.join(f'{type(error).__name__} {error}'.split())})"
        ) from error
    return arrays


def _kind_and_nodes(block: Any) -> tuple[str, Any]:
    return (block.type, block.data) if hasattr(block, "type") else block


def _geometry_alone(content: bytes) -> bytes:
    """Leave out the sections of a MSH file that name groups, entities and data, which may fit the cells or not."""
    kept, at = [], 0
    while section := _MSH_SECTION.search(content, at):
        name = section.group(1)
        end = content.find(b"$End" + name, section.end())
        at = len(content) if end < 0 else end + len(b"$End" + name)
        if name in _MSH_GEOMETRY:
            kept.append(content[section.start() : at] + b"\n")
    return b"".join(kept)


if __name__ == "__main__":
    sys.exit(main())
