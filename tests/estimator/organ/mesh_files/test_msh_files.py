"""MSH: written by Gmsh it is read as it is, damaged files are refused in one sentence."""

import numpy as np
import pytest

from estimator.mesh_file_checks import MM, check_volume, damaged, outcome
from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import enclosed_volume
from softtissue_estimator.organ.mesh_io import read_mesh


@pytest.fixture(scope="module")
def gmsh():
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("Mesh.MeshSizeMax", 15.0)
    yield gmsh
    gmsh.finalize()


def gmsh_box(gmsh, path, dimension=3, order=1, version=4.1, binary=False, hexahedra=False, group=False):
    """Write a box of 80 x 60 x 40 mm and return its nodes as Gmsh has them."""
    gmsh.clear()
    gmsh.model.occ.addBox(-10.0, 0.0, 5.0, 80.0, 60.0, 40.0)
    gmsh.model.occ.synchronize()
    if hexahedra:
        for _, curve in gmsh.model.getEntities(1):
            gmsh.model.mesh.setTransfiniteCurve(curve, 4)
        for _, surface in gmsh.model.getEntities(2):
            gmsh.model.mesh.setTransfiniteSurface(surface)
            gmsh.model.mesh.setRecombine(2, surface)
        gmsh.model.mesh.setTransfiniteVolume(1)
    gmsh.model.mesh.generate(dimension)
    gmsh.model.mesh.setOrder(order)
    if group:
        gmsh.model.addPhysicalGroup(3, [1], 7, name="liver of 'A', right")
    gmsh.option.setNumber("Mesh.MshFileVersion", version)
    gmsh.option.setNumber("Mesh.Binary", int(binary))
    gmsh.write(str(path))
    return gmsh.model.mesh.getNodes()[1].reshape(-1, 3)


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
@pytest.mark.parametrize("version", [2.2, 4.1])
@pytest.mark.parametrize("order", [1, 2])
def test_tetrahedra_of_gmsh(gmsh, tmp_path, version, binary, order):
    """Without physical groups Gmsh writes points, lines and triangles beside the tetrahedra."""
    nodes = gmsh_box(
        gmsh, tmp_path / "box.msh", version=version, binary=binary, order=order, group=order == 2
    )
    check_volume(read_mesh(tmp_path / "box.msh", MM), nodes, 80 * 60 * 40)


def test_surfaces_and_hexahedra_of_gmsh(gmsh, tmp_path):
    nodes = gmsh_box(gmsh, tmp_path / "box.msh", dimension=2)
    found = read_mesh(tmp_path / "box.msh", MM)
    assert (found.vertex_of_stored >= 0).all()
    np.testing.assert_allclose(found.mesh.vertices[found.vertex_of_stored], MM * nodes, atol=1e-9)
    assert abs(enclosed_volume(found.mesh)) == pytest.approx(80e-3 * 60e-3 * 40e-3)
    nodes = gmsh_box(gmsh, tmp_path / "hexa.MSH".lower(), hexahedra=True)
    check_volume(read_mesh((tmp_path / "hexa.msh").rename(tmp_path / "hexa.MSH"), MM), nodes, 80 * 60 * 40)


def test_another_version_of_msh_is_named(gmsh, tmp_path):
    gmsh_box(gmsh, tmp_path / "box.msh", version=4.0)
    with pytest.raises(
        MeshError, match="expected MSH version 2.2 or 4.1, got 4; save it as one of them in Gmsh"
    ):
        read_mesh(tmp_path / "box.msh", MM)


def test_damaged_files_of_gmsh_are_refused_or_read(gmsh, tmp_path):
    gmsh_box(gmsh, tmp_path / "box.msh", binary=True)
    whole = (tmp_path / "box.msh").read_bytes()
    outcomes = {outcome(tmp_path / "box.msh", content) for content in damaged(whole, 2, 4)}
    assert outcomes <= {"mesh", "one sentence"}
    assert outcome(tmp_path / "box.msh", whole) == "mesh"


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
@pytest.mark.parametrize("version", [2.2, 4.1])
@pytest.mark.parametrize("groups", [[3], [1, 2], [0, 2, 3]])
def test_groups_on_a_part_change_nothing(gmsh, tmp_path, version, binary, groups):
    """Gmsh's option to save all cells, though some belong to no group; data of some cells and nodes beside them."""
    path = tmp_path / "box.msh"
    nodes = gmsh_box(gmsh, path)
    for number, dimension in enumerate(groups):
        tags = [tag for _, tag in gmsh.model.getEntities(dimension)][: 1 + dimension % 2]
        gmsh.model.addPhysicalGroup(dimension, tags, 5 + number, name=f"group {number}")
    gmsh.option.setNumber("Mesh.MshFileVersion", version)
    gmsh.option.setNumber("Mesh.Binary", int(binary))
    gmsh.option.setNumber("Mesh.SaveAll", 1)
    gmsh.write(str(path))
    gmsh.option.setNumber("Mesh.SaveAll", 0)
    beside = b'$ElementData\n1\n"x"\n1\n0.0\n3\n0\n1\n2\n1 0.5\n2 0.5\n$EndElementData\n$Unknown\n1 2\n$EndUnknown\n'
    path.write_bytes(path.read_bytes() + beside)
    check_volume(read_mesh(path, MM), nodes, 80 * 60 * 40)


def test_the_coordinate_system_may_stand_in_a_comment(gmsh, tmp_path):
    nodes = gmsh_box(gmsh, tmp_path / "box.msh", binary=True)
    content = (tmp_path / "box.msh").read_bytes()
    (tmp_path / "box.msh").write_bytes(b"$Comments\nSPACE=RAS\n$EndComments\n" + content)
    check_volume(read_mesh(tmp_path / "box.msh", MM, "LPS"), nodes * [-1.0, -1.0, 1.0], 80 * 60 * 40)
