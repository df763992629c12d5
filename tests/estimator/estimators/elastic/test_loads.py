"""The loads that an organ may bear."""

from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from estimator.shapes import box_tets
from softtissue_estimator.estimators.elastic.elasticity import nodal_areas, nodal_volumes
from softtissue_estimator.estimators.elastic.loads import (
    MOST_PATCHES,
    PATCH_SPACING_M,
    SIZES,
    attachment_basis,
    load_basis,
)

MESH = box_tets((0.08, 0.05, 0.03), (9, 6, 4))


def patches_of_one_size(mesh, size, monkeypatch):
    """Patches (n, k) of a single size."""
    with monkeypatch.context() as context:
        context.setattr("softtissue_estimator.estimators.elastic.loads.SIZES", (size,))
        return load_basis(mesh)[:, :-1]


def middles_and_widths(mesh, patches):
    """Where each patch pushes most, (k, 3) m, and how far from there its root mean square is, (k,) m."""
    centres = mesh.nodes[patches.argmax(axis=0)]
    squared = ((mesh.nodes[:, None] - centres) ** 2).sum(axis=2)
    return centres, np.sqrt((patches * squared).sum(axis=0))


def test_every_load_is_one_newton_and_the_last_is_weight():
    loads = load_basis(MESH)
    np.testing.assert_allclose(loads.sum(axis=0), 1.0)
    np.testing.assert_allclose(loads[:, -1], nodal_volumes(MESH) / MESH.volumes.sum())


def test_patches_of_every_size_act_on_the_surface_and_cover_it(monkeypatch):
    surface = nodal_areas(MESH) > 0.0
    counts = []
    for size in SIZES:
        patches = patches_of_one_size(MESH, size, monkeypatch)
        assert (patches[~surface] == 0.0).all()
        centres, width = middles_and_widths(MESH, patches)
        assert cKDTree(centres).query(MESH.nodes[surface])[0].max() < 2.0 * size * PATCH_SPACING_M
        assert (width < 2.0 * size * PATCH_SPACING_M).all()
        counts.append(patches.shape[1])
    assert all(coarse < fine for fine, coarse in pairwise(counts))


def test_loads_are_patches_of_all_sizes_with_the_fine_ones_first(monkeypatch):
    by_size = [patches_of_one_size(MESH, size, monkeypatch) for size in SIZES]
    np.testing.assert_array_equal(load_basis(MESH)[:, :-1], np.concatenate(by_size, axis=1))
    widths = [np.median(middles_and_widths(MESH, patches)[1]) for patches in by_size]
    # A wide patch is bent about edges of a small organ.
    assert 1.5 < widths[1] / widths[0] < SIZES[1] / SIZES[0] + 0.1


def test_far_from_a_patch_nothing_pushes_rather_than_next_to_nothing():
    large = box_tets((0.30, 0.20, 0.15), (24, 16, 12))
    loads = load_basis(large)[:, :-1]
    pushing = loads[loads != 0.0]
    assert len(pushing) < 0.9 * (nodal_areas(large) > 0.0).sum() * loads.shape[1]
    assert pushing.min() > 1e-20 > np.finfo(np.float32).tiny


def test_large_organs_get_larger_patches_not_more(monkeypatch):
    large = box_tets((0.30, 0.20, 0.15), (24, 16, 12))
    fine = patches_of_one_size(large, SIZES[0], monkeypatch)
    assert fine.shape[1] == MOST_PATCHES
    whole = load_basis(large)[:, :-1]
    np.testing.assert_array_equal(whole[:, :MOST_PATCHES], fine)
    # What is wide is so in proportion to what is fine.
    widths = middles_and_widths(large, whole)[1]
    assert np.median(widths[:MOST_PATCHES]) > 1.3 * np.sqrt(2.0) * PATCH_SPACING_M * 11.0 / 12.0
    assert 1.7 < np.median(widths[MOST_PATCHES:]) / np.median(widths[:MOST_PATCHES]) < 2.3


def test_nothing_pushes_what_is_attached():
    areas = nodal_areas(MESH)
    held = MESH.nodes[:, 0] < 0.02
    loads = load_basis(MESH, np.where(held, areas, 0.0))
    assert (loads[held, :-1] == 0.0).all()
    np.testing.assert_allclose(loads.sum(axis=0), 1.0)
    assert 1 < loads.shape[1] < load_basis(MESH).shape[1]


def test_what_holds_the_organ_moves_in_patches_as_a_whole_and_along_each_axis():
    areas = nodal_areas(MESH)
    held = (MESH.nodes[:, 0] < 0.03) & (areas > 0.0)
    springs = np.diag(np.where(held, 500.0 * areas, 0.0))
    forces = attachment_basis(MESH, springs, np.where(held, areas, 0.0))
    assert (forces[~held] == 0.0).all()
    # By one metre, or all by as much as their distance from the middle, of one size.
    moved = forces[held] / np.diag(springs)[held, None]
    patches, whole, along = moved[:, :-4], moved[:, -4], moved[:, -3:]
    assert patches.shape[1] > 1
    np.testing.assert_allclose(patches.sum(axis=1), 1.0)
    np.testing.assert_allclose(whole, 1.0)
    apart = MESH.nodes[held] - MESH.nodes[held].mean(axis=0)
    np.testing.assert_allclose(along / along[0, 0], apart / apart[0, 0], atol=1e-12)
    assert 0.5 < np.sqrt((along**2).sum(axis=1).mean()) < 1.0


def test_nothing_holds_an_organ_that_is_attached_nowhere():
    assert attachment_basis(MESH, np.eye(len(MESH.nodes)), np.zeros(len(MESH.nodes))).shape == (
        len(MESH.nodes),
        0,
    )
