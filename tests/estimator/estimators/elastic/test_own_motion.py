"""An organ that is attached nowhere: its own motion and what bends it are told apart."""

import dataclasses

import numpy as np
import pytest
import torch

from estimator.shapes import ellipsoid, ellipsoid_tets, organ_of
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.elastic.own_motion import beside_own_motion, own_motion
from softtissue_estimator.estimators.elastic.registration_error import expected_error
from softtissue_estimator.estimators.elastic.tangent import Tangent
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.observation.rigid import RigidMotion, fit_rigid
from softtissue_estimator.organ.mesh import sample_faces

SURFACE = ellipsoid((0.08, 0.05, 0.04), subdivisions=2)
ORGAN = organ_of(SURFACE, np.zeros(len(SURFACE.vertices), dtype=bool), ellipsoid_tets((0.08, 0.05, 0.04)))
CONFIG = EstimatorConfig(poisson_ratio_sigma=0.0)
STILL = RigidMotion(np.eye(3), np.zeros(3))


@pytest.fixture(scope="module")
def model():
    return ElasticEstimator(CONFIG).precompute(ORGAN)


def tangent_of(model, state):
    return model.body.linearise(state, torch.zeros_like(state), 0.35)


def rigid_share(displacement, positions):
    """How far the best rigid motion of displacements (n, 3) moves the positions over how far they move, squared."""
    found = fit_rigid(positions, positions + 1e-3 * displacement)
    return np.square(found.apply(positions) - positions).sum() / np.square(1e-3 * displacement).sum()


def test_loads_bend_an_organ_that_has_a_motion_of_its_own(model):
    turned = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    state = model.nodes @ turned.T - model.nodes
    tangent = tangent_of(model, state)
    beside = beside_own_motion(tangent, model.nodes, own_motion(ORGAN.centre, STILL))
    positions = (model.nodes + state).numpy()
    for column in (0, 100, 301):
        whole = tangent.response[:, column].view(-1, 3).double().numpy()
        bent = beside.response[:, column].view(-1, 3).double().numpy()
        scale = np.abs(whole).max()
        assert rigid_share(whole / scale, positions) > 0.5  # what the springs let it do
        assert rigid_share(bent / scale, positions) < 1e-4 < np.square(bent / scale).mean()
    assert beside.offset is tangent.offset


def test_loads_move_an_organ_that_is_held(model):
    tangent = Tangent(*(torch.zeros(1) for _ in range(4)))
    assert beside_own_motion(tangent, model.nodes, expected_error(ORGAN.centre, 0.01, 0.1)) is tangent


def test_a_stream_of_an_organ_that_is_attached_nowhere_does_not_drift_away():
    """Bent, turned and shifted to and fro for six seconds: hidden parts stay where they are."""
    estimator = ElasticEstimator(dataclasses.replace(CONFIG, tracking=True, tracking_patience_s=60.0))
    estimator.load_organ(ORGAN)
    points = sample_faces(SURFACE, SURFACE.triangles[:, :, 2].mean(axis=1) > 0.015, 0.004)[0]
    errors = []
    try:
        for number in range(60):
            share = np.sin(2.0 * np.pi * number / 40.0)
            seen, truth = (moved(places, share) for places in (points, SURFACE.vertices))
            stamp_s = 0.1 * number
            observation = Observation(points, seen - points, np.full(len(points), 0.0005), stamp_s=stamp_s)
            answer = estimator.estimate(observation)
            errors.append(np.linalg.norm(SURFACE.vertices + answer.displacement - truth, axis=1).mean())
    finally:
        estimator.close()
    late = np.array(errors[20:])
    assert late.max() < 0.0015
    assert late[-20:].mean() < 1.2 * late[:20].mean()


def moved(places, share):
    """Bent by up to 6 mm, turned by up to 0.15 rad and shifted by up to 10 mm."""
    bent = places + share * np.column_stack([np.zeros((len(places), 2)), 1.0 * places[:, 0] ** 2])
    angle = 0.15 * share
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    return bent @ turn.T + share * np.array([0.01, 0.0, 0.005])
