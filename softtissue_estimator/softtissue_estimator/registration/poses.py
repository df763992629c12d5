"""Many rigid poses of an organ at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softtissue_estimator.observation.rigid import RigidMotion

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Poses:
    """Motions x -> R x + t from the organ's frame to the cloud's.

    Attributes
    ----------
    rotation
        (k, 3, 3), proper.
    translation
        (k, 3) m.
    """

    rotation: FloatArray
    translation: FloatArray

    @classmethod
    def of(cls, motions: Sequence[RigidMotion]) -> Poses:
        """Put motions together, at least one."""
        return cls(
            np.stack([one.rotation for one in motions]), np.stack([one.translation for one in motions])
        )

    def __len__(self) -> int:
        return len(self.rotation)

    def __getitem__(self, chosen: IntArray | slice) -> Poses:
        return Poses(self.rotation[chosen], self.translation[chosen])

    def motion(self, index: int) -> RigidMotion:
        """Return one of them."""
        return RigidMotion(self.rotation[index], self.translation[index])

    def and_also(self, others: Poses) -> Poses:
        """Return these and others."""
        return Poses(
            np.concatenate([self.rotation, others.rotation]),
            np.concatenate([self.translation, others.translation]),
        )

    def apply(self, points: FloatArray) -> FloatArray:
        """Move points (n, 3) m of the organ, or (k, n, 3) m, those of each pose, (k, n, 3)."""
        return self.turn(points) + self.translation[:, None]

    def turn(self, vectors: FloatArray) -> FloatArray:
        """Turn vectors (n, 3) of the organ, or (k, n, 3), those of each pose, (k, n, 3)."""
        return np.asarray(vectors @ np.swapaxes(self.rotation, 1, 2))

    def undo(self, points: FloatArray) -> FloatArray:
        """Move points (n, 3) m of the cloud into the organ's frame, (k, n, 3)."""
        back = np.einsum("kd,kde->ke", self.translation, self.rotation)
        return np.asarray(points @ self.rotation - back[:, None])

    def undo_turn(self, vectors: FloatArray) -> FloatArray:
        """Turn vectors (n, 3) of the cloud into the organ's frame, (k, n, 3)."""
        return np.asarray(vectors @ self.rotation)

    def moved(self, steps: FloatArray, centre: FloatArray) -> Poses:
        """Move each pose by small steps.

        Parameters
        ----------
        steps
            (k, 6): of the organ's centre, m, and then a rotation about it, rad, both along the organ's axes; k may be
            any where there is one pose.
        centre
            (3,) m, organ's frame.
        """
        rotation = self.rotation @ Rotation.from_rotvec(steps[:, 3:]).as_matrix()
        at = self.rotation @ centre + self.translation
        shifted = at + np.einsum("...de,...e->...d", self.rotation, steps[:, :3])
        return Poses(rotation, shifted - rotation @ centre)

    def steps_from(self, origin: RigidMotion, centre: FloatArray) -> FloatArray:
        """Return the steps, as `moved` has them, that lead from one pose to each of these, (k, 6)."""
        turn = Rotation.from_matrix(origin.rotation.T @ self.rotation).as_rotvec()
        shift = self.rotation @ centre + self.translation - origin.apply(centre[None])[0]
        return np.concatenate([shift @ origin.rotation, turn], axis=1)


@dataclass(frozen=True, eq=False)
class PosePrior:
    """What is known of a pose beforehand.

    Attributes
    ----------
    mean
        From the organ's frame to the cloud's.
    covariance
        (6, 6) of a translation of the organ's centre, m, and a rotation about it, rad, along the organ's axes.
    """

    mean: RigidMotion
    covariance: FloatArray

    def log_density(self, poses: Poses, centre: FloatArray) -> FloatArray:
        """Return the logarithm of the density of poses, (k,), up to a constant."""
        steps = poses.steps_from(self.mean, centre)
        return np.asarray(-0.5 * np.einsum("ka,ka->k", steps, np.linalg.solve(self.covariance, steps.T).T))

    def draw(self, count: int, centre: FloatArray, rng: np.random.Generator) -> Poses:
        """Draw poses."""
        steps = rng.multivariate_normal(np.zeros(6), self.covariance, count)
        return Poses.of([self.mean]).moved(steps, centre)


def spread_rotations(count: int) -> FloatArray:
    """Return rotations (count, 3, 3) that are spread evenly (Alexa 2022, super-Fibonacci spirals)."""
    along = np.arange(count) + 0.5
    inner, outer = np.sqrt(along / count), np.sqrt(1.0 - along / count)
    # The positive roots of p^2 = 2 and p^4 = p + 4.
    first, second = 2.0 * np.pi * along / np.sqrt(2.0), 2.0 * np.pi * along / 1.533751168755204
    quaternion = [
        inner * np.sin(first),
        inner * np.cos(first),
        outer * np.sin(second),
        outer * np.cos(second),
    ]
    return Rotation.from_quat(np.stack(quaternion, axis=1)).as_matrix()


def distinct(poses: Poses, scores: FloatArray, points: FloatArray, apart_m: float, most: int) -> IntArray:
    """Choose the best of poses that differ.

    Parameters
    ----------
    scores
        (k,).
    points
        (n, 3) m of the organ: poses differ by how far apart they put these on average.
    apart_m
        Poses nearer to a better one are left out, m.

    Returns
    -------
    (at most `most`,) indices, the best first.
    """
    placed = poses.apply(points)
    kept: list[int] = []
    for index in np.argsort(-scores, kind="stable"):
        if len(kept) == most:
            break
        away = np.linalg.norm(placed[kept] - placed[index], axis=2).mean(axis=1)
        if (away > apart_m).all():
            kept.append(int(index))
    return np.array(kept, dtype=np.int64)
