"""The loads that an organ may bear."""

import numpy as np
from scipy.spatial import cKDTree

from estimator.shapes import box_tets
from softtissue_estimator.estimators.elastic.elasticity import nodal_areas, nodal_volumes
from softtissue_estimator.estimators.elastic.loads import MOST_PATCHES, PATCH_SPACING_M, load_basis

MESH = box_tets((0.08, 0.05, 0.03), (9, 6, 4))


def test_every_load_is_one_newton_and_the_last_is_weight():
    loads = load_basis(MESH)
    np.testing.assert_allclose(loads.sum(axis=0), 1.0)
    np.testing.assert_allclose(loads[:, -1], nodal_volumes(MESH) / MESH.volumes.sum())


def test_patches_act_on_the_surface_and_cover_it():
    patches = load_basis(MESH)[:, :-1]
    surface = nodal_areas(MESH) > 0.0
    assert (patches[~surface] == 0.0).all()
    centres = MESH.nodes[patches.argmax(axis=0)]
    assert cKDTree(centres).query(MESH.nodes[surface])[0].max() < 2.0 * PATCH_SPACING_M
    width = np.sqrt((patches * ((MESH.nodes[:, None] - centres) ** 2).sum(axis=2)).sum(axis=0))
    assert (width < 2.0 * PATCH_SPACING_M).all()


def test_far_from_a_patch_nothing_pushes_rather_than_next_to_nothing():
    large = box_tets((0.30, 0.20, 0.15), (24, 16, 12))
    loads = load_basis(large)[:, :-1]
    pushing = loads[loads != 0.0]
    assert len(pushing) < 0.9 * (nodal_areas(large) > 0.0).sum() * loads.shape[1]
    assert pushing.min() > 1e-20 > np.finfo(np.float32).tiny


def test_large_organs_get_larger_patches_not_more():
    large = box_tets((0.30, 0.20, 0.15), (24, 16, 12))
    assert load_basis(large).shape[1] == MOST_PATCHES + 1


def test_nothing_pushes_what_is_attached():
    areas = nodal_areas(MESH)
    held = MESH.nodes[:, 0] < 0.02
    loads = load_basis(MESH, np.where(held, areas, 0.0))
    assert (loads[held, :-1] == 0.0).all()
    np.testing.assert_allclose(loads.sum(axis=0), 1.0)
    assert 1 < loads.shape[1] < load_basis(MESH).shape[1]
