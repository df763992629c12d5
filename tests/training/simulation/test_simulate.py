import dataclasses

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.organs.tetrahedralise import TetMesh, signed_volumes
from softtissue_training.physics import solver
from softtissue_training.simulation import simulate as simulation
from softtissue_training.simulation.boundary_conditions import DENSITY_KG_M3, weight
from softtissue_training.simulation.recipe import Recipe
from softtissue_training.simulation.simulate import simulate
from training.coarse import COARSE

REASONS = {
    "shape",
    "mesh",
    "patch too small",
    "load on attachment",
    "not converged",
    "moved too far",
    "left the cube",
    "no usable load",
}


def test_the_seed_and_number_decide(samples):
    again = simulate(3, 1, COARSE).simulations[0]
    other = simulate(4, 1, COARSE).simulations[0]
    np.testing.assert_array_equal(again.displacement, samples[1].displacement)
    np.testing.assert_array_equal(again.tets, samples[1].tets)
    assert other.vertices.shape != again.vertices.shape or not np.allclose(other.vertices, again.vertices)


def test_attached_vertices_stay_and_others_move(samples):
    for sample in samples:
        length = np.linalg.norm(sample.displacement, axis=1)
        assert len(sample.attached) >= 4
        assert (length[sample.attached] == 0.0).all()
        assert 0.0 < length.max() <= 0.10
        assert np.linalg.norm(sample.force.sum(axis=0)) <= 1.0


def test_pushed_patch_moves_along_with_the_force(samples):
    for sample in samples:
        assert float(np.sum(sample.force * sample.displacement)) > 0.0


def test_the_residual_is_small_and_kept(samples):
    assert all(0.0 < sample.residual < 1e-6 for sample in samples)


def test_rejections_are_counted():
    counted = {}
    for number in range(8):
        for reason, times in simulate(11, number, COARSE).rejected.items():
            counted[reason] = counted.get(reason, 0) + times
    assert counted
    assert set(counted) <= REASONS


def test_solves_are_given_up_early_only_where_they_are_refused_in_the_end(monkeypatch):
    iterations = []
    find = solver.find_equilibrium

    def counted(*arguments, **options):
        iterations.append(0)
        step = solver._newton_step

        def count(*given):
            iterations[-1] += 1
            return step(*given)

        with monkeypatch.context() as patched:
            patched.setattr(solver, "_newton_step", count)
            return find(*arguments, **options)

    monkeypatch.setattr(solver, "find_equilibrium", counted)
    recipe = dataclasses.replace(COARSE, force_n=(0.0, 3.0))
    soon, steps_soon = [simulate(12, number, recipe) for number in range(4)], sum(iterations)
    iterations.clear()
    monkeypatch.setattr(simulation, "_HOPELESS", np.inf)
    late, steps_late = [simulate(12, number, recipe) for number in range(4)], sum(iterations)
    assert sum(record.rejected.get("moved too far", 0) for record in late) >= 3
    assert steps_soon < steps_late
    for one, other in zip(soon, late, strict=True):
        assert one.rejected == other.rejected
        np.testing.assert_array_equal(one.simulations[0].displacement, other.simulations[0].displacement)


def test_load_cases_share_the_mesh_and_do_not_depend_on_how_many_there_are(samples):
    both = simulate(3, 1, dataclasses.replace(COARSE, load_cases=2)).simulations
    assert [sample.case for sample in both] == [0, 1]
    np.testing.assert_array_equal(both[0].displacement, samples[1].displacement)
    np.testing.assert_array_equal(both[0].vertices, both[1].vertices)
    assert not np.array_equal(both[0].force, both[1].force)
    assert set(both[0].attached) != set(both[1].attached)


def test_materials_come_from_the_recipe():
    recipe = dataclasses.replace(
        COARSE,
        laws=("neo_hookean", "st_venant_kirchhoff"),
        youngs_modulus_pa=(2000.0, 3000.0),
        poisson_ratio=(0.3, 0.4),
        load_cases=8,
    )
    materials = [sample.material for sample in simulate(5, 0, recipe).simulations]
    assert {material.law for material in materials} == {"neo_hookean", "st_venant_kirchhoff"}
    assert all(2000.0 <= material.youngs_modulus_pa <= 3000.0 for material in materials)
    assert len({material.poisson_ratio for material in materials}) == 8


def test_gravity_alone_lets_the_organ_hang():
    recipe = dataclasses.replace(COARSE, forces=(0, 0), gravity=(0.05, 0.1))
    sample = simulate(5, 1, recipe).simulations[0]
    assert 0.05 * 9.81 <= np.linalg.norm(sample.gravity) <= 0.1 * 9.81
    assert not sample.force.any()
    assert (sample.displacement @ sample.gravity).mean() > 0.0


def test_pressure_alone_pushes_its_patch_inwards():
    recipe = dataclasses.replace(COARSE, forces=(0, 0), pressure_pa=(20.0, 40.0))
    sample = simulate(5, 1, recipe).simulations[0]
    pressed = sample.faces[sample.pressure > 0.0]
    assert set(np.unique(sample.pressure[sample.pressure > 0.0]).tolist()) == {float(sample.pressure.max())}
    assert 20.0 <= sample.pressure.max() <= 40.0
    corners = sample.vertices[pressed].astype(float)
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    moved = sample.displacement[pressed].mean(axis=1)
    assert np.sum(moved * outward) < 0.0


def test_weight_is_mass_times_gravity(samples):
    mesh = TetMesh(
        samples[0].vertices.astype(float), samples[0].tets.astype(int), samples[0].faces.astype(int)
    )
    gravity = np.array([0.0, 3.0, -9.0])
    volume = signed_volumes(mesh.vertices, mesh.tets).sum()
    np.testing.assert_allclose(
        weight(mesh, gravity).sum(axis=0), DENSITY_KG_M3 * volume * gravity, rtol=1e-12
    )


def test_several_forces_push_several_patches():
    recipe = dataclasses.replace(COARSE, forces=(3, 3), force_n=(0.2, 0.2))
    sample = simulate(5, 2, recipe).simulations[0]
    directions = sample.force[np.linalg.norm(sample.force, axis=1) > 0]
    directions = directions / np.linalg.norm(directions, axis=1)[:, None]
    assert np.linalg.matrix_rank(directions, tol=1e-3) == 3


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"shapes": "kidney"}, "shapes must be one of"),
        ({"poisson_ratio": (0.3, 0.5)}, "poisson_ratio must be a range within 0 to 0.49, got 0.3 to 0.5"),
        ({"force_n": (1.0, 0.5)}, "force_n must be a range"),
        ({"laws": ("hooke",)}, "laws must be some of"),
        ({"load_cases": 0}, "load_cases must be at least 1"),
        ({"element_size_m": 0.1}, "element size must be 4 to 50 mm, got 100 mm"),
        ({"forces": (0, 0)}, "something must load the organ"),
    ],
)
def test_impossible_recipes_are_refused(settings, message):
    with pytest.raises(InvalidInputError, match=message):
        Recipe(**settings)


def test_a_recipe_survives_json():
    recipe = Recipe(laws=("neo_hookean", "st_venant_kirchhoff"), gravity=(0.0, 1.0), load_cases=3)
    assert Recipe.from_json(recipe.to_json()) == recipe
    with pytest.raises(InvalidInputError, match="no setting colour"):
        Recipe.from_json({"colour": "red"})
