"""What is observed of a prepared simulation: a patch, its noise, and what the estimator is told wrongly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from softtissue_estimator.estimators.paper.network_spec import NetworkSpec
from softtissue_estimator.estimators.paper.rigid_frame import RIGID, fit_frame_of_points, into_frame
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_training.learning.dataset import PreparedSample, draw_visible
from softtissue_training.learning.training_config import TrainingConfig

FloatArray = NDArray[np.float64]

_SMALLEST_SIGMA_M = 0.0002  # what is told of points without noise


@dataclass(frozen=True)
class View:
    """What a network is told of one simulation.

    Attributes
    ----------
    points
        (k, 3) float32 metres, preoperative positions of the visible points.
    displacement
        (k, 3) float32 metres, in the network's frame.
    motion
        The rigid motion of that frame; None: the organ's.
    attachment
        Which attached region it is told: 0 the true one, 1 a smaller, 2 a larger one.
    """

    points: Tensor
    displacement: Tensor
    motion: RigidMotion | None = None
    attachment: int = 0


def view_of(points: Tensor, displacement: Tensor, spec: NetworkSpec, sigma_m: float = 0.0) -> View:
    """Return the view of visible points (k, 3) m with displacements (k, 3) m in the organ's frame."""
    if spec.frame != RIGID:
        return View(points, displacement)
    before, moved = points.double().numpy(), displacement.double().numpy()
    motion = fit_frame_of_points(before, moved, max(sigma_m, _SMALLEST_SIGMA_M))
    return View(points, torch.from_numpy(into_frame(motion, before, moved)).float(), motion)


def draw_view(sample: PreparedSample, rng: np.random.Generator, config: TrainingConfig) -> View:
    """Draw what is observed of a sample in training, and what is wrong with it."""
    points, displacement = draw_visible(
        sample,
        rng,
        _draw_share(config, rng),
        correspondences=config.correspondences if rng.random() < config.sparse else None,
    )
    noise_m = rng.uniform(*config.noise_m) if rng.random() < config.noisy else 0.0
    if noise_m > 0.0:
        noise = rng.normal(scale=noise_m, size=displacement.shape)
        displacement = displacement + torch.from_numpy(noise.astype(np.float32))
    if rng.random() < config.misregistered:
        displacement = _misregistered(points, displacement, config, rng)
    view = view_of(points, displacement, config.spec, noise_m)
    attachment = int(rng.integers(1, 3)) if rng.random() < config.misattached else 0
    return View(view.points, view.displacement, view.motion, attachment)


def _draw_share(config: TrainingConfig, rng: np.random.Generator) -> tuple[float, float]:
    """Draw the visible share: half of them evenly from the common ones, if there are such."""
    if config.common_share is None:
        share = rng.uniform(*config.visible_share)
    elif rng.random() < 0.5:
        share = rng.uniform(*config.common_share)
    else:
        share = float(np.exp(rng.uniform(*np.log(config.visible_share))))
    return share, share


def _misregistered(
    points: Tensor, displacement: Tensor, config: TrainingConfig, rng: np.random.Generator
) -> Tensor:
    """Return displacements as observed with a registration that is off, turned about the middle of the points."""
    largest_rad, largest_m = config.misregistration
    direction, axis = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(rng.uniform(0.0, largest_rad) * axis)
    now = (points + displacement).double().numpy()
    middle = now.mean(axis=0)
    observed = turn.apply(now - middle) + middle + rng.uniform(0.0, largest_m) * direction
    return torch.from_numpy(observed - points.double().numpy()).float()
