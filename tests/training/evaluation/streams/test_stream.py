"""What is observed of a moving organ, and what is asked."""

import dataclasses

import numpy as np
import pytest

from softtissue_estimator.organ.mesh import face_areas
from softtissue_training.evaluation import inner_points
from softtissue_training.evaluation.case import depth_below
from softtissue_training.evaluation.streams.smooth_field import smooth_field, with_rms
from softtissue_training.evaluation.streams.stream import make_stream
from training.coarse import COARSE_STREAM

SEED = (5, 0)


def test_a_stream_is_what_the_settings_say(coarse_motions, coarse_streams):
    for motion, stream in zip(coarse_motions, coarse_streams, strict=True):
        low, high = stream.settings.visible_share
        largest = face_areas(stream.organ.surface).max() / face_areas(stream.organ.surface).sum()
        assert low <= stream.visible_share <= high + largest
        assert np.array_equal(stream.organ.attached, motion.attached)
        # The points lie on the visible part of the surface, at rest and moved.
        assert depth_below(stream.reference, stream.organ.surface, stream.visible).max() < 1e-9
        state = stream.surface_moved[7]
        deformed = dataclasses.replace(stream.organ.surface, vertices=stream.organ.surface.vertices + state)
        clean = stream.present(stream.reference)
        assert depth_below(clean[7], deformed, stream.visible).max() < 1e-9
        every = stream.present_by_frame(np.broadcast_to(stream.reference, clean.shape))
        assert np.allclose(every, clean, atol=1e-12)
        assert np.linalg.norm(clean[0] - stream.reference, axis=1).max() < 1e-9  # at rest
        outward = (stream.reference - stream.centre) * stream.normals
        assert (outward.sum(axis=1) > 0.0).mean() > 0.9
        assert np.linalg.norm(stream.viewing_direction) == pytest.approx(1.0)


def test_half_of_what_is_asked_is_far_from_what_is_seen(coarse_streams):
    for stream in coarse_streams:
        depth = depth_below(stream.inner, stream.organ.surface, stream.visible)
        assert stream.depth == pytest.approx(depth)
        half = stream.settings.inner_points // 2
        assert len(stream.inner) == len(np.unique(stream.inner, axis=0)) == 2 * half
        assert (stream.depth[:half] > inner_points.FAR_M).all() or stream.depth[:half].min() >= stream.depth[
            half:
        ].max()
        # Truth is the simulation's, linear in each of its elements.
        tet = stream.volume.locate(stream.inner)
        weights = stream.volume.weights(stream.inner, tet)
        assert weights.min() > -1e-9  # inside
        assert stream.truth.shape == (len(stream.times), 2 * half, 3)


def test_truth_is_the_motion(coarse_motions, coarse_streams):
    motion, stream = coarse_motions[0], coarse_streams[0]
    tet = stream.volume.locate(stream.inner)
    weights = stream.volume.weights(stream.inner, tet)
    moved = motion.at(stream.times)[:, motion.mesh.tets[tet]]
    assert np.allclose(stream.truth, np.einsum("pa,fpac->fpc", weights, moved), atol=1e-9)


def test_an_organ_without_far_places_gives_its_farthest(coarse_motions, monkeypatch):
    monkeypatch.setattr(inner_points, "FAR_M", 0.5)
    stream = make_stream(coarse_motions[0], "organ", SEED, COARSE_STREAM)
    half = stream.settings.inner_points // 2
    assert stream.depth[:half].min() >= stream.depth[half:].max()
    assert (stream.depth > inner_points.FAR_M).sum() == 0


def test_a_stream_is_its_seeds(coarse_motions, coarse_streams):
    again = make_stream(coarse_motions[0], "moving_000000", SEED, COARSE_STREAM)
    for name in ("reference", "noise", "inner", "truth", "visible"):
        assert np.array_equal(getattr(again, name), getattr(coarse_streams[0], name))
    other = make_stream(coarse_motions[0], "moving_000000", (6, 0), COARSE_STREAM)
    assert not np.array_equal(again.noise[:, :50], other.noise[:, :50])


def test_smooth_fields_have_the_correlation_asked_for():
    """Over many fields: exp(-1/2) at the length and at the duration, unit variance."""
    points = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.0, 0.0, 0.2]])
    times = np.array([0.0, 1.5, 30.0])
    drawn = np.stack(
        [
            smooth_field(points, times, 1, 0.02, 1.5, np.random.default_rng(seed))[..., 0]
            for seed in range(3000)
        ]
    )
    assert (drawn**2).mean() == pytest.approx(1.0, abs=0.05)
    product = (drawn[:, :1, :1] * drawn).mean(axis=0)
    assert product[0, 1] == pytest.approx(np.exp(-0.5), abs=0.06)
    assert product[1, 0] == pytest.approx(np.exp(-0.5), abs=0.06)
    assert product[1, 1] == pytest.approx(np.exp(-1.0), abs=0.06)
    assert abs(product[0, 2]) < 0.06 and abs(product[2, 0]) < 0.06
    constant = smooth_field(points, times, 2, 0.02, np.inf, np.random.default_rng(0))
    assert constant.shape == (3, 3, 2) and np.ptp(constant, axis=0).max() < 1e-12
    assert np.sqrt((with_rms(constant, 0.004) ** 2).sum(axis=-1).mean()) == pytest.approx(0.004)
