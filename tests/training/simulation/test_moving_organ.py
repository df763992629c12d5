"""Organs that move: each key state is an equilibrium, courses start at rest, loads and organs are the seed's."""

import dataclasses

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.organs.tetrahedralise import TetMesh
from softtissue_training.physics.load_path import follow
from softtissue_training.physics.material import Material
from softtissue_training.physics.pressure import SurfacePressure
from softtissue_training.physics.solver import solve
from softtissue_training.simulation.motion_format import format_motion, parse_motion
from softtissue_training.simulation.moving_organ import PEAK_M, Course, random_course, simulate_motion
from training.coarse import COARSE_MOTION


def test_a_motion_starts_at_rest_and_moves_as_far_as_it_should(coarse_motions):
    for motion in coarse_motions:
        moved = np.linalg.norm(motion.displacement, axis=2)
        assert moved[0].max() == 0.0
        assert 0.75 * PEAK_M[0] <= moved.max() <= 1.25 * PEAK_M[1]
        assert np.abs(motion.displacement[:, : len(motion.attached)][:, motion.attached]).max() == 0.0
        fine = motion.at(np.linspace(0.0, motion.times[-1], 201))
        assert np.allclose(motion.at(motion.times), motion.displacement, atol=1e-12)
        speed = np.linalg.norm(np.diff(fine, axis=0), axis=2).max() / (motion.times[-1] / 200)
        assert 0.005 < speed < 0.15
        assert np.linalg.norm(fine[1], axis=1).max() < 0.002  # no start at full speed


def test_the_same_seed_gives_the_same_motion_and_another_one_another(coarse_motions):
    again = simulate_motion(5, 0, COARSE_MOTION)
    assert np.array_equal(again.displacement, coarse_motions[0].displacement)
    assert again.about == coarse_motions[0].about
    assert coarse_motions[0].mesh.vertices.shape != coarse_motions[1].mesh.vertices.shape


def test_a_path_of_loads_leads_to_the_equilibrium_of_each(samples):
    """Against the solver that brings the body from rest to each load."""
    sample = samples[0]
    nodes, tets = sample.vertices.astype(np.float64), sample.tets.astype(np.int64)
    fixed = np.zeros(len(nodes), dtype=bool)
    fixed[sample.attached] = True
    forces = np.array([0.3, 1.0, 0.4])[:, None, None] * sample.force.astype(np.float64)
    pressed = np.zeros(len(sample.faces))
    pressed[::7] = 100.0
    pressures = tuple(
        SurfacePressure(sample.faces.astype(np.int64), share * pressed) for share in (0.0, 0.5, 1.0)
    )
    found = follow(nodes, tets, fixed, forces, Material(), pressures)
    for state, force, pressure in zip(found, forces, pressures, strict=True):
        alone = solve(nodes, tets, fixed, force, Material(), pressure=pressure)
        assert np.abs(state - alone.displacement).max() < 1e-5
    assert np.abs(found[0] - found[2]).max() > 1e-3


def test_courses_are_smooth_and_reach_their_levels():
    course = Course(((1.0, 2.0, 0.8), (4.0, 1.0, 0.2)))
    times = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 4.5, 5.0, 9.0])
    assert course.at(times) == pytest.approx([0.0, 0.0, 0.4, 0.8, 0.8, 0.5, 0.2, 0.2])
    fine = course.at(np.linspace(0.0, 10.0, 1001))
    assert np.abs(np.diff(fine)).max() < 1.9 * 0.01 * 0.8
    drawn = random_course(np.random.default_rng(0), (0.0, 0.5), 10.0)
    starts, durations, levels = np.array(drawn.changes).T
    assert (np.diff(starts) > durations[:-1]).all() and levels[0] >= 0.6 and levels[1] <= 0.4


def test_a_motion_survives_its_file(coarse_motions):
    motion = coarse_motions[1]
    content = format_motion(motion)
    assert content == format_motion(motion)
    read = parse_motion(content, "file")
    assert isinstance(read.mesh, TetMesh) and np.array_equal(read.mesh.tets, motion.mesh.tets)
    assert np.abs(read.displacement - motion.displacement).max() < 1e-8
    assert read.about["seed"] == [5, 1]
    assert read.about["states"] == COARSE_MOTION.states
    with pytest.raises(InvalidInputError, match="file: expected a motion, got"):
        parse_motion(content[:-100], "file")


def test_loads_are_redrawn_where_a_motion_cannot_be_used(coarse_motions):
    """Of a recipe whose loads hardly move anything compared with gravity, all draws still end in the range."""
    settings = dataclasses.replace(
        COARSE_MOTION, recipe=dataclasses.replace(COARSE_MOTION.recipe, gravity=(0.1, 0.1))
    )
    motion = simulate_motion(5, 3, settings)
    assert 0.75 * PEAK_M[0] <= np.linalg.norm(motion.displacement, axis=2).max() <= 1.25 * PEAK_M[1]
