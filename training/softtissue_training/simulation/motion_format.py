"""What a motion says as the bytes of an `.npz` file."""

from __future__ import annotations

import io
import json

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.organs.tetrahedralise import TetMesh
from softtissue_training.simulation.moving_organ import MovingOrgan


def format_motion(motion: MovingOrgan) -> bytes:
    """Return a motion as the bytes of an `.npz` file; the same motion gives the same bytes."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        about=np.frombuffer(json.dumps(motion.about, sort_keys=True).encode(), dtype=np.uint8),
        vertices=motion.mesh.vertices.astype(np.float32),
        tets=motion.mesh.tets.astype(np.int32),
        faces=motion.mesh.faces.astype(np.int32),
        attached=motion.attached,
        times=motion.times,
        displacement=motion.displacement.astype(np.float32),
    )
    return buffer.getvalue()


def parse_motion(content: bytes, source: str) -> MovingOrgan:
    """Read what `format_motion` made.

    Raises
    ------
    InvalidInputError
        The bytes are not a complete motion; `source` says where they are from.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        mesh = TetMesh(
            arrays["vertices"].astype(np.float64),
            arrays["tets"].astype(np.int64),
            arrays["faces"].astype(np.int64),
        )
        return MovingOrgan(
            mesh,
            arrays["attached"],
            arrays["times"],
            arrays["displacement"].astype(np.float64),
            json.loads(arrays["about"].tobytes()),
        )
    except Exception as error:  # a damaged file may raise anything
        raise InvalidInputError(
            f"{source}: expected a motion, got {type(error).__name__}: {error}"
        ) from error
