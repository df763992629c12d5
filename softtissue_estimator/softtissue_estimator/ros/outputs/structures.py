"""`~/structures`: what the rows of `~/deformed_points` and `~/deformed_surface` are."""

from array import array

import numpy as np
from softtissue_msgs.msg import Structures
from std_msgs.msg import ColorRGBA

from softtissue_estimator.organ.organ import Organ


def structures_message(organ: Organ) -> Structures:
    """Describe names, kinds, colours and triangles of an organ's structures, and the triangles of its surface."""
    message = Structures(organ=organ.name)
    message.header.frame_id = organ.frame
    message.names = [structure.name for structure in organ.structures]
    message.kinds = [structure.kind for structure in organ.structures]
    for structure in organ.structures:
        red, green, blue, opacity = structure.colour
        message.colours.append(ColorRGBA(r=red, g=green, b=blue, a=opacity))
    vertices = np.cumsum([0, *(len(structure.mesh.vertices) for structure in organ.structures)])
    triangles = np.cumsum([0, *(len(structure.mesh.faces) for structure in organ.structures)])
    faces = [s.mesh.faces + first for s, first in zip(organ.structures, vertices, strict=False)]
    message.first_vertex, message.first_face = vertices.tolist(), triangles.tolist()
    packed = np.concatenate([np.empty((0, 3), dtype=np.int64), *faces]).astype(np.uint32)
    message.faces = array("I", packed.tobytes())
    message.surface_faces = array("I", organ.surface.faces.astype(np.uint32).tobytes())
    return message
