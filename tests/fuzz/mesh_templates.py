"""One organ in every format that is accepted: what the damaged mesh files are made of."""

import functools
import io
import random
import tempfile
from pathlib import Path

import numpy as np
import trimesh

from estimator.shapes import box_tets, ellipsoid

SURFACE = ellipsoid((90.0, 60.0, 50.0), subdivisions=2)
BOX = box_tets((80.0, 60.0, 40.0), (3, 2, 2))


@functools.cache
def templates() -> dict[str, bytes]:
    """Contents by name; what needs a library that is not installed is not there."""
    ball = trimesh.Trimesh(SURFACE.vertices, SURFACE.faces, process=False)
    found = {
        "binary.stl": ball.export(file_type="stl"),
        "text.stl": ball.export(file_type="stl_ascii"),
        "binary.ply": ball.export(file_type="ply"),
        "text.ply": ball.export(file_type="ply", encoding="ascii"),
        "plain.obj": _obj(textured=False),
        "textured.obj": _obj(textured=True),
        "textured.ply": _textured_ply(),
        "mixed.ply": _mixed_binary_ply(),
        **_msh(),
        **_vtk(),
    }
    return {name: data if isinstance(data, bytes) else data.encode() for name, data in found.items()}


def choose(rng: random.Random, names: list[str]) -> str:
    """Choose a name, those of one suffix together as often as those of another."""
    suffix = rng.choice(sorted({Path(name).suffix for name in names}))
    return rng.choice([name for name in names if name.endswith(suffix)])


def _obj(textured: bool) -> str:
    lines = ["# SPACE=LPS" if textured else "# an organ", "o organ", "mtllib organ.mtl"]
    lines += [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in SURFACE.vertices]
    if textured:
        lines += ["vt 0.0 0.0", "vt 1.0 0.5", "vn 0 0 1", "usemtl tissue", "s off"]
    corner = "{0}/1/1" if textured else "{0}"
    lines += ["f " + " ".join(corner.format(v) for v in face) for face in SURFACE.faces + 1]
    return "\n".join(lines) + "\n"


def _textured_ply() -> str:
    header = ["ply", "format ascii 1.0", "comment SPACE=LPS", f"element vertex {len(SURFACE.vertices)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "quality")]
    header += [f"element face {len(SURFACE.faces)}", "property list uchar int vertex_indices"]
    header += ["property list uchar float texcoord", "end_header"]
    rows = [f"{x:.5f} {y:.5f} {z:.5f} 1" for x, y, z in SURFACE.vertices]
    rows += [f"3 {a} {b} {c} 6 0 0 1 0 0 1" for a, b, c in SURFACE.faces]
    return "\n".join(header + rows) + "\n"


def _mixed_binary_ply() -> bytes:
    header = ["ply", "format binary_big_endian 1.0", f"element vertex {len(SURFACE.vertices)}"]
    header += [f"property double {name}" for name in "xyz"]
    header += [f"element face {len(SURFACE.faces) + 1}", "property list uint int vertex_index", "end_header"]
    body = SURFACE.vertices.astype(">f8").tobytes()
    for face in SURFACE.faces:
        body += np.array([3, *face], dtype=">i4").tobytes()
    return "\n".join([*header, ""]).encode() + body + np.array([2, 0, 1], dtype=">i4").tobytes()


def _msh() -> dict[str, bytes]:
    try:
        import meshio
    except ImportError:
        return {}
    tags = {f"gmsh:{kind}": [np.ones(len(BOX.tets), dtype=np.int32)] for kind in ("physical", "geometrical")}
    mesh = meshio.Mesh(BOX.nodes, [("tetra", BOX.tets)], cell_data=tags)
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for version, binary in (("22", False), ("22", True), ("4", False), ("4", True)):
            path = Path(folder) / "organ.msh"
            meshio.gmsh.write(path, mesh, fmt_version="2.2" if version == "22" else "4.1", binary=binary)
            found[f"{'binary' if binary else 'text'}{version}.msh"] = path.read_bytes()
    return found


def _vtk() -> dict[str, bytes]:
    try:
        from vtkmodules import vtkCommonCore, vtkCommonDataModel, vtkIOLegacy, vtkIOXML
        from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    except ImportError:
        return {}

    def data_of(data, points, cells, kind):
        places, array = vtkCommonCore.vtkPoints(), vtkCommonDataModel.vtkCellArray()
        places.SetData(numpy_to_vtk(points.astype(np.float32), deep=True))
        listed = np.column_stack([np.full(len(cells), cells.shape[1]), cells]).ravel()
        array.ImportLegacyFormat(numpy_to_vtkIdTypeArray(listed, deep=True))
        data.SetPoints(places)
        data.SetPolys(array) if kind is None else data.SetCells(kind, array)
        return data

    surface = data_of(vtkCommonDataModel.vtkPolyData(), SURFACE.vertices, SURFACE.faces, None)
    volume = data_of(vtkCommonDataModel.vtkUnstructuredGrid(), BOX.nodes, BOX.tets, 10)
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "organ"

        def write(name, writer, data, how):
            getattr(writer, how)()
            writer.SetFileName(str(path))
            writer.SetInputData(data)
            writer.Write()
            found[name] = path.read_bytes()

        for version in (42, 51):
            for how in ("SetFileTypeToASCII", "SetFileTypeToBinary"):
                for data, what in ((surface, "surface"), (volume, "volume")):
                    writer = vtkIOLegacy.vtkDataSetWriter()
                    writer.SetFileVersion(version)
                    write(
                        f"{'text' if how.endswith('ASCII') else 'binary'}{version}-{what}.vtk",
                        writer,
                        data,
                        how,
                    )
        for how in ("SetDataModeToAscii", "SetDataModeToAppended", "SetDataModeToBinary"):
            word = how.removeprefix("SetDataModeTo").lower()
            write(f"{word}.vtp", vtkIOXML.vtkXMLPolyDataWriter(), surface, how)
            write(f"{word}.vtu", vtkIOXML.vtkXMLUnstructuredGridWriter(), volume, how)
    return found


def organ_yaml(surface: str, structures: tuple[tuple[str, str], ...] = ()) -> str:
    """Text of an `organ.yaml`: names of files, of the surface and of structures by name."""
    text = io.StringIO()
    text.write(
        f"name: Organ\nunit: mm\nsurface: {surface}\nattached: {{patch: {{centre: [90, 0, 0], share: 0.1}}}}\n"
    )
    if structures:
        text.write("structures:\n")
    for name, file in structures:
        text.write(f"  - {{name: {name}, kind: vessel, mesh: {file}, colour: [1, 0.5, 0]}}\n")
    return text.getvalue()
