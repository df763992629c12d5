"""What a laparoscope sees besides an organ: the wall of the cavity, other organs, instruments.

All are surfaces, in the organ's frame, so that they hide each other and the organ as such things do.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.view.rendering import vertex_normals
from softtissue_training.phantom.pose import Pose
from softtissue_training.scene.instrument import grasper, held, joined, probe
from softtissue_training.scene.world import Moment

FloatArray = NDArray[np.float64]

ORGAN, WALL, NEIGHBOUR, INSTRUMENT = range(4)
"""Labels of surfaces."""

_WALL_GAP_M = (0.008, 0.035)
_GAS_HALF_WIDTH_M = (0.070, 0.120)
_BEHIND_CAMERA_M = 0.020
_BUMP_M, _BUMP_LENGTH_M = 0.004, 0.050
_NEIGHBOURS, _NEIGHBOUR_HALF_AXIS_M = (1, 3), (0.025, 0.060)
_INSTRUMENTS, _TIP_ABOVE_M = (0, 2), (0.002, 0.020)
_PORT_ASIDE_M = (0.050, 0.120)


def surround(organ: SurfaceMesh, camera: Pose, rng: np.random.Generator) -> Moment:
    """Put an organ, as it is deformed, into a cavity that a camera at a pose in the organ's frame looks into.

    Returns
    -------
    Moment
        All surfaces; labels are `ORGAN`, `WALL`, `NEIGHBOUR` and `INSTRUMENT`.
    """
    parts, labels = [organ, _wall(organ, camera, rng)], [ORGAN, WALL]
    for _ in range(rng.integers(*_NEIGHBOURS, endpoint=True)):
        parts.append(_neighbour(organ, camera, rng))
        labels.append(NEIGHBOUR)
    for _ in range(rng.integers(*_INSTRUMENTS, endpoint=True)):
        parts.append(_instrument(organ, camera, rng))
        labels.append(INSTRUMENT)
    mesh = joined(parts)
    label = [np.full(len(part.faces), name, dtype=np.uint8) for part, name in zip(parts, labels, strict=True)]
    return Moment(mesh, mesh.vertices, np.concatenate(label))


def _wall(organ: SurfaceMesh, camera: Pose, rng: np.random.Generator) -> SurfaceMesh:
    """Make a surface around the organ, which it follows at a distance, and around the gas before the camera."""
    sphere = trimesh.creation.icosphere(subdivisions=4)
    direction = np.asarray(sphere.vertices)
    middle = organ.vertices.mean(axis=0)
    radius = _reach(organ.vertices - middle, direction) + rng.uniform(*_WALL_GAP_M)
    # An ellipsoid of gas from the organ's middle to behind the camera.
    to_camera = camera.position - middle
    length = float(np.linalg.norm(to_camera))
    half = np.array([0.5 * length + _BEHIND_CAMERA_M, *rng.uniform(*_GAS_HALF_WIDTH_M, 2)])
    axes = _axes_along(to_camera / length)
    scaled, offset = direction @ axes.T / half, -0.5 * (axes @ to_camera) / half
    a, b, c = (scaled**2).sum(axis=1), scaled @ offset, offset @ offset - 1.0
    gas = (-b + np.sqrt(np.maximum(b**2 - a * c, 0.0))) / a
    bumps = _bumps(direction * radius[:, None], rng)
    return SurfaceMesh(
        middle + direction * (np.maximum(radius, gas) + bumps)[:, None], np.asarray(sphere.faces)
    )


def _neighbour(organ: SurfaceMesh, camera: Pose, rng: np.random.Generator) -> SurfaceMesh:
    """Make a rounded body beside the organ, as the camera sees it."""
    middle = organ.vertices.mean(axis=0)
    axes = _axes_along((camera.position - middle) / np.linalg.norm(camera.position - middle))
    angle, lift = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.7, 0.3)
    towards = np.cos(lift) * (np.cos(angle) * axes[1] + np.sin(angle) * axes[2]) + np.sin(lift) * axes[0]
    half = rng.uniform(*_NEIGHBOUR_HALF_AXIS_M, 3)
    sphere = trimesh.creation.icosphere(subdivisions=3)
    turned = np.asarray(sphere.vertices) * half @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    away = _reach(organ.vertices - middle, towards[None])[0] + rng.uniform(0.3, 0.9) * half.mean()
    moved = middle + away * towards + turned
    outwards = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return SurfaceMesh(moved + _bumps(moved, rng)[:, None] * outwards, np.asarray(sphere.faces))


def _instrument(organ: SurfaceMesh, camera: Pose, rng: np.random.Generator) -> SurfaceMesh:
    """Hold an instrument over a part of the organ that faces the camera."""
    normals = vertex_normals(organ)
    to_camera = camera.position - organ.vertices
    facing = np.flatnonzero((normals * to_camera).sum(axis=1) > 0.5 * np.linalg.norm(to_camera, axis=1))
    over = int(rng.choice(facing)) if len(facing) else 0
    tip = organ.vertices[over] + rng.uniform(*_TIP_ABOVE_M) * normals[over]
    angle = rng.uniform(0.0, 2.0 * np.pi)
    aside = camera.rotation @ np.array([np.cos(angle), np.sin(angle), 0.0])
    tool = probe() if rng.random() < 0.5 else grasper(rng.uniform(0.05, 0.4))
    pose = held(tip, camera.position + rng.uniform(*_PORT_ASIDE_M) * aside)
    return SurfaceMesh(pose.outer(tool.vertices), tool.faces)


def _reach(offset: FloatArray, direction: FloatArray) -> FloatArray:
    """How far points (n, 3) m reach into directions (k, 3), (k,) m; smooth, and not less than they do."""
    along = offset @ direction.T
    length = np.linalg.norm(offset, axis=1)[:, None]
    # What lies more than about 30 degrees aside does not count.
    near = np.clip((along / np.maximum(length, 1e-9) - 0.80) / 0.10, 0.0, 1.0)
    return np.asarray((near * length).max(axis=0))


def _axes_along(forward: FloatArray) -> FloatArray:
    """Three unit vectors as rows, (3, 3), the first of which is `forward`."""
    other = np.eye(3)[int(np.argmin(np.abs(forward)))]
    side = np.cross(forward, other)
    side /= np.linalg.norm(side)
    return np.stack([forward, side, np.cross(forward, side)])


def _bumps(points: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Heights (n,) m of shallow random bumps at points (n, 3) m."""
    number = rng.normal(0.0, 1.0 / _BUMP_LENGTH_M, (16, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, 16)
    return np.asarray(_BUMP_M * np.sqrt(2.0 / 16.0) * np.cos(points @ number.T + phase).sum(axis=1))
