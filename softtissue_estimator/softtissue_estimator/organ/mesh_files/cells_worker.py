"""Read a mesh file with VTK or meshio and write its arrays to an NPZ file: a program of its own, run by `isolated`.

These libraries take what a damaged file says for true: they may end the process or ask for any amount of memory. With
exit code 3, the last line on stderr says why the file cannot be read.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np

UNREADABLE = 3
_LEAST_MEMORY_BYTES = 4 << 30  # beside a multiple of the file's size
_MEMORY_BYTES_PER_FILE_BYTE = 200


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
    except _UnreadableError as error:
        print(error, file=sys.stderr)
        return UNREADABLE
    np.savez(target, **arrays)
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
    arrays = {"points": to_numpy(data.GetPoints().GetData())}
    for i, (types, part) in enumerate(cells):
        if part is not None and part.GetNumberOfCells() > 0:
            arrays[f"types{i}"] = types
            arrays[f"offsets{i}"] = to_numpy(part.GetOffsetsArray())
            arrays[f"nodes{i}"] = to_numpy(part.GetConnectivityArray())
    return arrays


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


def _read_msh(source: str) -> dict[str, Any]:
    """Points; kind and nodes of each block of cells."""
    # meshio's own `read` ends the program if it cannot read a file.
    from meshio.gmsh import read

    # numpy warns of numbers that end too early; what is missing then shows in the shapes.
    warnings.simplefilter("ignore")
    try:
        mesh = read(source)
        arrays: dict[str, Any] = {"points": np.asarray(mesh.points, dtype=np.float64)}
        for i, block in enumerate(mesh.cells):
            arrays[f"kind{i}"] = np.array(block.type)
            arrays[f"nodes{i}"] = np.asarray(block.data, dtype=np.int64)
    except Exception as error:
        # It raises whatever it stumbles over in damaged files: ReadError, ValueError, IndexError, KeyError, ...
        raise _UnreadableError(
            f"damaged or cut off ({' '.join(f'{type(error).__name__} {error}'.split())})"
        ) from error
    return arrays


if __name__ == "__main__":
    sys.exit(main())
