"""The laparoscope's image: wet tissue under a light beside the lens."""

import io

import numpy as np
from matplotlib import image as files
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from softtissue_training.phantom.pose import Pose
from softtissue_training.scene.camera import StereoCamera
from softtissue_training.scene.view import normals_seen, see
from softtissue_training.scene.world import ORGAN, SURFACES, Moment

Array = NDArray[np.float64]

_COLOUR = {
    "organ": (0.33, 0.060, 0.036),
    "wall": (0.80, 0.29, 0.21),
    "stomach": (0.86, 0.42, 0.34),
    "fat": (0.88, 0.58, 0.20),
    "probe": (0.30, 0.31, 0.33),
    "grasper": (0.30, 0.31, 0.33),
}
_BLOOD = np.array([0.50, 0.06, 0.06])
_VESSELS = {"wall": 0.55, "stomach": 0.65, "fat": 0.45, "organ": 0.0}
"""How clearly small vessels are drawn."""
_SHINE = {"organ": 0.55, "wall": 0.22, "stomach": 0.40, "fat": 0.35, "probe": 0.75, "grasper": 0.75}
_COATED = {"grasper": 0.030, "probe": 0.030}
"""From how far behind its tip (m) an instrument's shaft has a black coat."""
_LIGHT_M = np.array([-0.004, -0.006, 0.0])  # camera's frame
_FULL_LIGHT_M = 0.095  # at this distance the light is neither strong nor weak
_QUALITY = 82
_SUPERSAMPLING = 2


class Painter:
    """Paints a camera's images; textures stick to the surfaces, so that features can be followed.

    Parameters
    ----------
    rng
        Draws the textures.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._table = rng.random((32, 32, 32))

    def jpeg(self, moment: Moment, pose: Pose, camera: StereoCamera) -> bytes:
        """Image as a JPEG file."""
        stream = io.BytesIO()
        picture = np.round(255.0 * self.paint(moment, pose, camera)).astype(np.uint8)
        files.imsave(stream, picture, format="jpeg", pil_kwargs={"quality": _QUALITY})
        return stream.getvalue()

    def paint(self, moment: Moment, pose: Pose, camera: StereoCamera) -> Array:
        """Image ``(rows, columns, 3)``, red, green and blue from 0 to 1."""
        fine = camera.larger(_SUPERSAMPLING)
        view = see(moment, pose, fine)
        image = np.zeros((fine.rows, fine.columns, 3))
        rows, columns = np.nonzero(view.seen)
        pixels = np.stack([columns, rows], axis=1).astype(float)
        position = fine.triangulate(pixels, view.disparity[rows, columns])
        label = moment.label[view.triangle[rows, columns]]
        normal = normals_seen(view, moment, pose, rows, columns)
        rest = view.blend(moment.rest, moment.mesh.faces, rows, columns)
        image[rows, columns] = self._light(position, normal, rest, label)
        image *= _vignette(fine)[..., None]
        blocks = image.reshape(camera.rows, _SUPERSAMPLING, camera.columns, _SUPERSAMPLING, 3)
        return np.asarray(np.clip(blocks.mean(axis=(1, 3)), 0.0, 1.0) ** (1.0 / 2.2))

    def _light(self, position: Array, normal: Array, rest: Array, label: NDArray[np.uint8]) -> Array:
        """Linear colours ``(k, 3)`` of lit points ``(k, 3)`` m in the camera's frame."""
        away = -position / np.linalg.norm(position, axis=1, keepdims=True)
        normal = np.where(np.sum(normal * away, axis=1, keepdims=True) < 0.0, -normal, normal)
        tissue = (label < SURFACES.index("probe"))[:, None]
        bumps = np.stack([self.noise(rest + shift, 0.0026, 2) for shift in (0.0, 0.31, 0.57)], axis=1)
        rough = normal + np.where(tissue, 0.55, 0.02) * (bumps - 0.5)
        rough /= np.linalg.norm(rough, axis=1, keepdims=True)
        towards = _LIGHT_M - position
        distance = np.linalg.norm(towards, axis=1, keepdims=True)
        towards = towards / distance
        half = towards + away
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        strength = (_FULL_LIGHT_M / distance) ** 2
        facing = np.clip(np.sum(rough * towards, axis=1, keepdims=True), 0.0, 1.0)
        gloss = np.clip(np.sum(rough * half, axis=1, keepdims=True), 0.0, 1.0)
        shine = np.array([_SHINE[name] for name in SURFACES])[label][:, None]
        colour = self._colour(rest, label)
        lit = colour * (0.08 + 1.5 * facing) * strength + shine * strength * (
            1.6 * gloss**220 + 0.08 * gloss**14
        )
        return np.asarray(1.0 - np.exp(-1.25 * lit))

    def _colour(self, rest: Array, label: NDArray[np.uint8]) -> Array:
        """Colours ``(k, 3)`` of surfaces at places ``(k, 3)`` m where they rest."""
        colour = np.array([_COLOUR[name] for name in SURFACES])[label]
        mottled = 0.35 + 1.30 * (0.55 * self.noise(rest, 0.0018, 2) + 0.45 * self.noise(rest + 0.9, 0.016, 3))
        colour = colour * np.where((label < SURFACES.index("probe"))[:, None], mottled[:, None], 1.0)
        # Small vessels run where a smooth noise passes its middle.
        ridge = np.abs(self.noise(rest + 0.2, 0.016, 2) - 0.5)
        here = np.clip(6.0 * (self.noise(rest + 0.7, 0.026, 1) - 0.46), 0.0, 1.0)
        clear = np.array([_VESSELS.get(name, 0.0) for name in SURFACES])[label] * here
        clear = clear * np.exp(-((ridge / (0.004 + 0.016 * here)) ** 2))
        colour = colour + clear[:, None] * (_BLOOD * 0.9 - colour)
        organ = label == ORGAN
        pale = np.clip(self.noise(rest[organ] + 0.4, 0.030, 2) - 0.55, 0.0, 1.0)[:, None]
        colour[organ] += 0.5 * pale * (np.array([0.62, 0.26, 0.18]) - colour[organ])
        for name, start in _COATED.items():
            coat = (label == SURFACES.index(name)) & (rest[:, 2] > start)
            colour[coat] = 0.015
        return np.asarray(colour)

    def noise(self, points: Array, length: float, octaves: int) -> Array:
        """Smooth noise ``(k,)``, 0 to 1, at points ``(k, 3)`` m; its features are about `length` (m) wide."""
        total, weight = np.zeros(len(points)), 0.0
        for octave in range(octaves):
            scaled = points.T * 2.0**octave / length + 7.3 * octave
            whole = np.floor(scaled)
            part = scaled - whole
            smooth = whole + part**2 * (3.0 - 2.0 * part)
            total += 0.5**octave * map_coordinates(self._table, smooth, order=1, mode="grid-wrap")
            weight += 0.5**octave
        return total / weight


def _vignette(camera: StereoCamera) -> Array:
    """Darkening ``(rows, columns)`` towards the corners, 0 to 1."""
    column, row = np.meshgrid(np.arange(camera.columns), np.arange(camera.rows))
    radius = np.hypot(column - camera.centre[0], row - camera.centre[1]) / (0.5 * camera.columns)
    return np.asarray(1.0 / (1.0 + (radius / 1.15) ** 6))
