import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.errors import SolverDivergedError
from softtissue_training.organs.tetrahedralise import TetMesh
from softtissue_training.phantom.mooney_rivlin import energy_density, mooney_rivlin, stress_and_tangent
from softtissue_training.phantom.quadratic_mesh import Interpolator, shape_functions, to_quadratic
from softtissue_training.phantom.statics import Body

CONSTANTS = torch.tensor([400.0, 130.0, 9000.0], dtype=torch.float64)
SIDE = 0.03


def cube(cells: int = 2) -> TetMesh:
    """A cube of 3 cm, each cell cut into six tetrahedra along its diagonal, with its boundary."""
    axis = np.linspace(0.0, SIDE, cells + 1)
    vertices = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(vertices)).reshape((cells + 1,) * 3)
    steps = np.eye(3, dtype=int)
    tets = []
    for cell in np.ndindex(cells, cells, cells):
        for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]):
            path = np.cumsum([np.array(cell), *steps[order]], axis=0)
            tet = [number[tuple(corner)] for corner in path]
            edges = vertices[tet[1:]] - vertices[tet[0]]
            tets.append(tet if np.linalg.det(edges) > 0.0 else [tet[0], tet[2], tet[1], tet[3]])
    tets = np.array(tets)
    triangles = tets[:, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True, return_counts=True)
    return TetMesh(vertices, tets, triangles[first[count == 1]])


@pytest.fixture(scope="module")
def mesh():
    return to_quadratic(cube())


@pytest.fixture(scope="module")
def body(mesh):
    return Body(mesh, mooney_rivlin(3000.0, 0.45), mesh.nodes[:, 2] == 0.0)


def deformation_gradients(count=6, size=0.25):
    generator = torch.Generator().manual_seed(2)
    f = torch.eye(3, dtype=torch.float64) + size * torch.randn(
        count, 3, 3, generator=generator, dtype=torch.float64
    )
    return f[torch.linalg.det(f) > 0.3]


def test_stress_and_tangent_are_the_derivatives_of_the_energy():
    f = deformation_gradients()
    assert len(f) >= 3
    stress, tangent = stress_and_tangent(f, CONSTANTS.expand(len(f), 3))
    for number in range(len(f)):
        expected = torch.func.grad(energy_density)(f[number], CONSTANTS)
        torch.testing.assert_close(stress[number], expected, rtol=1e-10, atol=1e-8)
        expected = torch.func.jacrev(torch.func.grad(energy_density))(f[number], CONSTANTS)
        torch.testing.assert_close(tangent[number], expected, rtol=1e-10, atol=1e-8)


def test_energy_does_not_change_with_a_rotation():
    f = deformation_gradients(1)[0]
    turn = torch.tensor(Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix())
    torch.testing.assert_close(energy_density(turn @ f, CONSTANTS), energy_density(f, CONSTANTS))


def test_small_strain_has_the_wanted_moduli():
    young, nu = 3000.0, 0.45
    material = mooney_rivlin(young, nu)
    constants = torch.tensor(
        [[material.c10_pa, material.c01_pa, material.bulk_modulus_pa]], dtype=torch.float64
    )
    _, tangent = stress_and_tangent(torch.eye(3, dtype=torch.float64)[None], constants)
    # Uniaxial stress: the strain (1, -nu, -nu) needs E along the axis and nothing across.
    stress = torch.einsum("iJkL,kL->iJ", tangent[0], torch.tensor(np.diag([1.0, -nu, -nu])))
    torch.testing.assert_close(stress, torch.tensor(np.diag([young, 0.0, 0.0])), rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize(("young", "nu"), [(0.0, 0.3), (-1.0, 0.3), (3000.0, 0.5), (3000.0, 0.0)])
def test_impossible_material_is_refused(young, nu):
    with pytest.raises(InvalidInputError, match="expected E > 0"):
        mooney_rivlin(young, nu)


def test_shape_functions_are_one_at_their_node_and_zero_at_the_others(mesh):
    element = mesh.nodes[mesh.elements[0]]
    corners = np.concatenate([element[:4].T, np.ones((1, 4))])
    barycentric = np.linalg.solve(corners, np.concatenate([element.T, np.ones((1, 10))])).T
    np.testing.assert_allclose(shape_functions(barycentric), np.eye(10), atol=1e-12)


def test_interpolation_reproduces_quadratic_fields_inside_and_a_little_outside(mesh):
    def field(x):
        return np.stack([x[:, 0] * x[:, 1], x[:, 2] ** 2 - x[:, 0], 1.0 + 3.0 * x[:, 1] * x[:, 2]], axis=1)

    points = np.random.default_rng(5).uniform(-0.001, SIDE + 0.001, (300, 3))
    values = Interpolator(mesh).weights(points) @ field(mesh.nodes)
    np.testing.assert_allclose(values, field(points), atol=1e-12)


def test_midside_nodes_of_the_boundary_lie_between_its_corners(mesh):
    corners = mesh.nodes[mesh.faces]
    np.testing.assert_allclose(
        mesh.nodes[mesh.face_midsides], 0.5 * (corners + np.roll(corners, -1, axis=1)), atol=1e-15
    )


def test_rotated_body_resists_with_no_force(body, mesh):
    turn = Rotation.from_rotvec([0.2, 0.9, -0.4]).as_matrix()
    force = body.internal_force(mesh.nodes @ turn.T - mesh.nodes)
    assert np.abs(force).max() < 1e-12


def test_homogeneous_deformation_gives_the_stress_on_every_side(body, mesh):
    f = np.array([[1.1, 0.15, 0.0], [0.0, 0.95, 0.05], [-0.1, 0.0, 1.2]])
    force = body.internal_force(mesh.nodes @ (f - np.eye(3)).T)
    material = mooney_rivlin(3000.0, 0.45)
    constants = torch.tensor([material.c10_pa, material.c01_pa, material.bulk_modulus_pa])
    stress = torch.func.grad(energy_density)(torch.tensor(f), constants.double()).numpy()
    inner = np.all((mesh.nodes > 1e-9) & (mesh.nodes < SIDE - 1e-9), axis=1)
    assert inner.any()
    # Equilibrium: nothing inside, and the moment of the nodal forces is the stress times the volume.
    np.testing.assert_allclose(force[inner], 0.0, atol=1e-6 * np.abs(force).max())
    np.testing.assert_allclose(force.T @ mesh.nodes, stress * SIDE**3, rtol=1e-6, atol=1e-9)


def test_equilibrium_balances_load_and_reaction(body, mesh):
    load = np.zeros_like(mesh.nodes)
    top = mesh.nodes[:, 2] == SIDE
    load[top] = np.array([0.3, -0.1, 0.2]) / np.count_nonzero(top)
    state = body.solve(load, np.zeros_like(load))
    assert state.residual < 1e-8
    np.testing.assert_allclose(state.reaction, [-0.3, 0.1, -0.2], atol=1e-8)
    held = mesh.nodes[:, 2] == 0.0
    np.testing.assert_array_equal(state.displacement[held], 0.0)
    assert state.displacement[top, 0].mean() > 0.002
    np.testing.assert_allclose(body.internal_force(state.displacement)[~held], load[~held], atol=1e-9)


def test_load_that_tears_the_body_apart_is_reported(body, mesh):
    load = np.where(mesh.nodes[:, 2:] == SIDE, np.array([0.0, 0.0, -1e3]), 0.0)
    with pytest.raises(SolverDivergedError, match=r"residual|line search"):
        body.solve(load, np.zeros_like(load))


def test_body_that_is_attached_nowhere_is_refused(mesh):
    with pytest.raises(InvalidInputError, match="at least one set"):
        Body(mesh, mooney_rivlin(3000.0, 0.45), np.zeros(len(mesh.nodes), dtype=bool))


def test_default_precision_of_torch_is_left_alone(body, mesh):
    body.internal_force(np.zeros_like(mesh.nodes))
    assert torch.get_default_dtype() == torch.float32


def test_springs_add_their_pull_to_the_internal_force(mesh, body):
    rng = np.random.default_rng(4)
    blocks = rng.normal(size=(len(mesh.nodes), 3, 3))
    springs = blocks @ np.swapaxes(blocks, 1, 2)
    attached = mesh.nodes[:, 2] == 0.0
    displacement = 1e-4 * rng.normal(size=mesh.nodes.shape)
    on_springs = Body(mesh, mooney_rivlin(3000.0, 0.45), attached, springs)
    pull = on_springs.internal_force(displacement) - body.internal_force(displacement)
    np.testing.assert_allclose(pull, [s @ u for s, u in zip(springs, displacement, strict=True)], atol=1e-12)


def test_newton_on_springs_converges_as_fast_as_without(mesh, body):
    springs = np.zeros((len(mesh.nodes), 3, 3))
    top = mesh.nodes[:, 2] == SIDE
    springs[top] = [[2.0, 0.5, 0.0], [0.5, 1.0, 0.2], [0.0, 0.2, 3.0]]
    on_springs = Body(mesh, mooney_rivlin(3000.0, 0.45), mesh.nodes[:, 2] == 0.0, springs)
    force = np.where(top[:, None], [4e-3, 0.0, -2e-3], 0.0)
    rest = np.zeros_like(mesh.nodes)
    held, free = on_springs.solve(force, rest), body.solve(force, rest)
    assert held.iterations <= free.iterations + 1 <= 8
    # The springs are stretched, and carry part of the load.
    assert np.linalg.norm(held.displacement[top].mean(axis=0)) < np.linalg.norm(
        free.displacement[top].mean(axis=0)
    )
    carried = np.einsum("ij,nj->i", springs[np.argmax(top)], held.displacement[top])
    np.testing.assert_allclose(held.reaction + force.sum(axis=0) - carried, 0.0, atol=1e-8)


def test_springs_of_a_wrong_shape_are_refused(mesh):
    with pytest.raises(InvalidInputError, match="expected springs of shape"):
        Body(mesh, mooney_rivlin(3000.0, 0.45), mesh.nodes[:, 2] == 0.0, np.zeros((3, 3)))
