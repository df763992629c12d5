"""What is drawn of a simulation to train on: shares, noise, few points, registrations and attachments that are off."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from softtissue_estimator.estimators.paper.network_spec import NetworkSpec
from softtissue_estimator.estimators.paper.rigid_frame import fit_frame_of_points, into_frame, out_of_frame
from softtissue_estimator.observation.rigid import fit_rigid
from softtissue_training.learning.dataset import prepare
from softtissue_training.learning.training_config import get_config
from softtissue_training.learning.view import View, draw_view, view_of
from softtissue_training.learning.voxels import Voxeliser

PLAIN = get_config("tiny", noisy=0.0, sparse=0.0)
IN_ORGAN = dataclasses.replace(PLAIN, spec=NetworkSpec(spacing=PLAIN.spec.spacing, margin_cells=1))
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def prepared(samples):
    return prepare(samples[1], PLAIN.spec, misattachment=0.3)


def _views(prepared, config, count):
    return [draw_view(prepared, np.random.default_rng(seed), config) for seed in range(count)]


def test_a_view_in_the_rigid_frame_is_the_same_view_seen_from_the_fitted_motion(prepared):
    for own, organs in zip(_views(prepared, PLAIN, 5), _views(prepared, IN_ORGAN, 5), strict=True):
        assert organs.motion is None and own.attachment == organs.attachment == 0
        assert torch.equal(own.points, organs.points)
        points, moved = organs.points.double().numpy(), organs.displacement.double().numpy()
        expected = fit_frame_of_points(points, moved, 2e-4)
        np.testing.assert_array_equal(own.motion.rotation, expected.rotation)
        seen = into_frame(expected, points, moved)
        np.testing.assert_allclose(own.displacement.numpy(), seen, rtol=0, atol=1e-8)
        assert np.linalg.norm(seen, axis=1).mean() < np.linalg.norm(moved, axis=1).mean()


def test_half_of_the_shares_are_common_ones_and_the_others_spread_over_orders_of_magnitude(prepared):
    config = dataclasses.replace(IN_ORGAN, common_share=(0.3, 0.4), visible_share=(0.02, 1.0))
    shares = np.array([len(view.points) for view in _views(prepared, config, 300)]) / len(prepared.points)
    common = (shares > 0.28) & (shares < 0.42)
    # Beside half of them, a fourteenth of the others: log(0.42 / 0.28) / log(1 / 0.02) is a tenth.
    assert common.mean() == pytest.approx(0.55, abs=0.09)
    others = shares[~common]
    assert others.min() < 0.05 and others.max() > 0.8
    assert np.median(others) < 0.28  # evenly, it would be a half
    even = dataclasses.replace(config, common_share=None)
    shares = np.array([len(view.points) for view in _views(prepared, even, 300)]) / len(prepared.points)
    assert np.median(shares) == pytest.approx(0.51, abs=0.09)


def test_noise_and_few_points_come_in_the_share_of_views_that_is_asked_for(prepared):
    noisy = dataclasses.replace(IN_ORGAN, noisy=0.3, noise_m=(0.002, 0.002))
    clean, found = _views(prepared, IN_ORGAN, 100), _views(prepared, noisy, 100)
    noises = [(one.displacement - other.displacement) for one, other in zip(found, clean, strict=True)]
    with_noise = [noise for noise in noises if noise.any()]
    assert len(with_noise) == pytest.approx(30, abs=13)
    assert float(torch.cat(with_noise).std()) == pytest.approx(0.002, rel=0.05)
    sparse = dataclasses.replace(IN_ORGAN, sparse=0.25, correspondences=(5, 9), visible_share=(0.3, 0.3))
    counts = np.array([len(view.points) for view in _views(prepared, sparse, 100)])
    assert (counts <= 9).sum() == pytest.approx(25, abs=13)
    assert counts.min() >= 5 and not ((counts > 9) & (counts < 30)).any()


def test_a_registration_that_is_off_moves_what_is_seen_rigidly_and_leaves_the_target(prepared):
    config = dataclasses.replace(IN_ORGAN, misregistered=1.0)
    angles, shifts = [], []
    for right, wrong in zip(_views(prepared, IN_ORGAN, 40), _views(prepared, config, 40), strict=True):
        assert torch.equal(right.points, wrong.points)
        before = (right.points + right.displacement).double().numpy()
        after = (wrong.points + wrong.displacement).double().numpy()
        motion = fit_rigid(before, after)
        np.testing.assert_allclose(motion.apply(before), after, rtol=0, atol=1e-7)
        angles.append(math.degrees(Rotation.from_matrix(motion.rotation).magnitude()))
        shifts.append(np.linalg.norm(after.mean(axis=0) - before.mean(axis=0)))
    assert max(angles) <= 10.01 and np.mean(angles) == pytest.approx(5.0, abs=1.5)
    assert max(shifts) <= 0.0201 and np.mean(shifts) == pytest.approx(0.010, abs=0.003)

    rigid = dataclasses.replace(PLAIN, misregistered=1.0)
    centres = prepared.grid.points()
    inside = (prepared.signed_distance <= 0).reshape(-1).numpy()
    for view in _views(prepared, rigid, 3):
        _, target, _ = Voxeliser(rigid.spec, CPU)([prepared], [view])
        in_frame = target[0].permute(1, 2, 3, 0).reshape(-1, 3).double().numpy() * rigid.spec.output_scale
        told = out_of_frame(view.motion, centres, in_frame)[inside]
        truth = prepared.target.reshape(-1, 3).double().numpy()[inside]
        np.testing.assert_allclose(told, truth, rtol=0, atol=1e-6)
        assert not in_frame[~inside].any()
    some = dataclasses.replace(IN_ORGAN, misregistered=0.2)
    changed = [
        not torch.equal(one.displacement, other.displacement)
        for one, other in zip(_views(prepared, some, 100), _views(prepared, IN_ORGAN, 100), strict=True)
    ]
    assert sum(changed) == pytest.approx(20, abs=12)


def test_the_attached_region_is_told_too_small_or_too_large_and_nothing_else_changes(prepared):
    always = dataclasses.replace(PLAIN, misattached=1.0)
    drawn = [view.attachment for view in _views(prepared, always, 40)]
    assert set(drawn) == {1, 2} and drawn.count(1) == pytest.approx(20, abs=10)
    view = view_of(*_pair(prepared), PLAIN.spec)
    voxelise = Voxeliser(PLAIN.spec, CPU)
    told = {kind: voxelise([prepared], [dataclasses.replace(view, attachment=kind)]) for kind in (0, 1, 2)}
    flags = {kind: inputs[0, 4] > 0 for kind, (inputs, _, _) in told.items()}
    assert torch.equal(flags[0], prepared.zero_displacement > 0)
    smaller, true, larger = (int(flags[kind].sum()) for kind in (1, 0, 2))
    assert smaller < true < larger
    assert not (flags[1] & ~flags[0]).any() and not (flags[0] & ~flags[2]).any()
    seen = told[0][0][0, 5] > 0
    for kind in (1, 2):
        inputs, target, mask = told[kind]
        assert torch.equal(target, told[0][1]) and torch.equal(mask, told[0][2])
        assert torch.equal(inputs[:, [0, 5]], told[0][0][:, [0, 5]])
        # The displacement of attached tissue stands where the network is told that it is attached.
        moved = inputs[0, 1:4].abs().amax(dim=0) > 0
        assert torch.equal(moved & ~seen, flags[kind] & ~seen)
        assert torch.equal(inputs[0, 1:4][:, seen], told[0][0][0, 1:4][:, seen])


def _pair(prepared) -> tuple[torch.Tensor, torch.Tensor]:
    view = draw_view(prepared, np.random.default_rng(3), IN_ORGAN)
    return view.points, view.displacement


def test_views_of_several_motions_are_voxelised_each_in_its_own(samples):
    config = dataclasses.replace(PLAIN, misregistered=1.0, misattached=1.0)
    several = [prepare(sample, PLAIN.spec, surroundings=True, misattachment=0.3) for sample in samples[:3]]
    views: list[View] = [
        draw_view(one, np.random.default_rng(seed), config) for seed, one in enumerate(several)
    ]
    together = Voxeliser(PLAIN.spec, CPU, keep=True)(several, views)
    for number, (sample, view) in enumerate(zip(several, views, strict=True)):
        alone = Voxeliser(PLAIN.spec, CPU)([sample], [view])
        for one, all_of_them in zip(alone, together, strict=True):
            torch.testing.assert_close(all_of_them[number : number + 1], one, rtol=0, atol=1e-6)
