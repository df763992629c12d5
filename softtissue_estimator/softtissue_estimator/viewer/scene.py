"""The three-dimensional part of the page: only what changed is sent. Methods of one thread."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softtissue_estimator.view.structures import FloatArray, Numbers, Structures
from softtissue_estimator.viewer.clipping import NOTHING_CUT, Clip, bounding_box, kept_faces
from softtissue_estimator.viewer.colours import LEFT_OUT, OBSERVED, ORGAN, Rgb
from softtissue_estimator.viewer.moment import CameraImage, Lens, Moment

_POINT_M = 0.0007
_FRUSTUM_M = 0.02
_PAGES_VIEW_RAD = 0.7
# Where the page looks from at first, in radii of the organ: from the front (-y), a little from above and the right.
_FROM = np.array([0.7, -2.6, 0.7])
_LIGHT = 0.5  # of the surroundings, beside lamps


@dataclass(frozen=True)
class Look:
    """What a user has chosen.

    Attributes
    ----------
    colours : tuple of (int, int, int)
        Of each structure.
    opacity : float
        Of the organ, 0 to 1.
    observed, frames : bool
        Show the observed points; the frames of organ and camera.
    clip : Clip
    """

    colours: tuple[Rgb, ...]
    opacity: float = 0.3
    observed: bool = True
    frames: bool = True
    clip: Clip = NOTHING_CUT


class Scene:
    """Nodes of one organ at a time.

    Parameters
    ----------
    server : viser.ViserServer
    """

    def __init__(self, server: Any) -> None:
        self._server, self._nodes = server, server.scene
        self._structures: Structures | None = None
        self._moment: Moment | None = None
        self._clip = NOTHING_CUT
        self._box: FloatArray = np.zeros((2, 3))
        self._parts: list[Any] = []
        self._organ: Any = None
        self._observed: Any = None
        self._nodes.configure_default_lights(enabled=True, cast_shadow=False)
        self._nodes.configure_environment_map("warehouse", environment_intensity=_LIGHT)
        self._nodes.set_up_direction("+z")
        self._nodes.world_axes.visible = False
        axes = {"axes_length": 0.02, "axes_radius": 0.0005, "origin_radius": 0.001, "visible": False}
        self._frame = self._nodes.add_frame("/organ_frame", **axes)
        self._camera = self._nodes.add_frame("/cloud_frame", **axes)
        self._image: CameraImage | None = None
        self._pyramid = self._nodes.add_camera_frustum(
            "/cloud_frame/pyramid",
            Lens().height_rad,
            Lens().aspect,
            scale=_FRUSTUM_M,
            thickness=0.0006,
            color=(120, 160, 230),
            cast_shadow=False,
            receive_shadow=False,
        )

    def show(
        self, structures: Structures, moment: Moment, look: Look, image: CameraImage | None = None
    ) -> None:
        """Draw a moment, with an image in the camera's pyramid."""
        with self._server.atomic():
            if structures is not self._structures:
                self._begin(structures, moment)
            changed = moment is not self._moment
            if changed:
                self._move(structures, moment)
            if look.clip != self._clip:
                self._cut(structures, look.clip)
            for part, colour in zip(self._parts, look.colours, strict=True):
                part.color, part.visible = colour, True
            if self._organ is not None:
                self._organ.opacity = look.opacity
                self._organ.visible = moment.surface is not None
            if self._observed is not None:
                self._observed.visible = look.observed and len(moment.observed) > 0
            self._camera.visible = look.frames and moment.camera is not None
            self._frame.visible = look.frames
            if image is not self._image:
                self._show_image(image)
            self._moment = moment

    def hide(self) -> None:
        """Show none of what belongs to an answer."""
        with self._server.atomic():
            for node in (*self._parts, self._organ, self._observed, self._camera, self._frame):
                if node is not None:
                    node.visible = False

    def _begin(self, structures: Structures, moment: Moment) -> None:
        """Make the nodes of another organ."""
        for node in (*self._parts, self._organ):
            if node is not None:
                node.remove()
        self._structures, self._organ, self._moment, self._clip = structures, None, None, NOTHING_CUT
        self._parts = [
            self._mesh(f"/structures/{number}", moment.points[structures.part(number)], faces)
            for number, faces in enumerate(structures.faces)
        ]
        self._box = bounding_box(moment.points if moment.surface is None else moment.surface)
        self._look_at_it()

    def _mesh(self, name: str, vertices: NDArray[np.float32], faces: Numbers, **looks: Any) -> Any:
        return self._nodes.add_mesh_simple(
            name, vertices, faces, cast_shadow=False, receive_shadow=False, side="double", **looks
        )

    def _look_at_it(self) -> None:
        """Place the camera, of pages that are open and of those that are opened later."""
        centre = self._box.mean(axis=0)
        radius = max(0.5 * float(np.linalg.norm(self._box[1] - self._box[0])), 1e-3)
        for camera in (self._server.initial_camera, *(c.camera for c in self._server.get_clients().values())):
            camera.fov, camera.near, camera.far = _PAGES_VIEW_RAD, 0.02 * radius, 200.0 * radius
            camera.position, camera.look_at = centre + radius * _FROM, centre

    def _move(self, structures: Structures, moment: Moment) -> None:
        """Take the places of what is drawn from another moment."""
        for number, part in enumerate(self._parts):
            part.vertices = moment.points[structures.part(number)]
        if moment.surface is not None and len(structures.surface_faces):
            if self._organ is None:
                self._box = bounding_box(moment.surface)
                faces = kept_faces(self._clip, moment.surface, structures.surface_faces, self._box)
                self._organ = self._mesh("/organ", moment.surface, faces, color=ORGAN, opacity=0.3)
            self._organ.vertices = moment.surface
        self._move_observed(moment)
        if moment.camera is not None:
            x, y, z, w = Rotation.from_matrix(moment.camera[:3, :3]).as_quat()
            self._camera.wxyz, self._camera.position = np.array([w, x, y, z]), moment.camera[:3, 3]

    def _move_observed(self, moment: Moment) -> None:
        if not len(moment.observed):
            return
        colours = np.where(moment.left_out[:, None], LEFT_OUT, OBSERVED).astype(np.uint8)
        if self._observed is not None and len(self._observed.points) == len(moment.observed):
            self._observed.points, self._observed.colors = moment.observed, colours
            return
        # Points and their colours cannot change their number one after the other.
        self._observed = self._nodes.add_point_cloud(
            "/observed",
            moment.observed,
            colours,
            point_size=_POINT_M,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )

    def _show_image(self, image: CameraImage | None) -> None:
        self._image = image
        self._pyramid.image = None if image is None else image.pixels
        if image is not None:
            self._pyramid.fov, self._pyramid.aspect = image.lens.height_rad, image.lens.aspect

    def _cut(self, structures: Structures, clip: Clip) -> None:
        """Cut the organ, and the structures if asked, as they are now."""
        self._clip = clip
        inner = clip if clip.structures else NOTHING_CUT
        for part, faces in zip(self._parts, structures.faces, strict=True):
            part.faces = kept_faces(inner, part.vertices, faces, self._box)
        if self._organ is not None:
            faces = kept_faces(clip, self._organ.vertices, structures.surface_faces, self._box)
            self._organ.faces = faces
