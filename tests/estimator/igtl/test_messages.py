"""Bytes of the messages, by the specification."""

import struct

import numpy as np
import pytest

from estimator.igtl.reference import crc64, split, surface
from estimator.shapes import rotation, sphere
from softtissue_estimator.errors import InvalidInputError

pytest.importorskip("pyigtl", reason="pyigtl, of the extra `igtl`, is not installed")

from pyigtl.messages import MessageBase

from softtissue_estimator.igtl.messages import (
    device_names,
    pack_surface,
    pack_text,
    pack_transform,
    to_ras_mm,
)


def test_surface_is_laid_out_as_specified():
    ball = sphere(0.01, centre=(0.1, 0.2, 0.3), subdivisions=2)
    message = pack_surface("tumour", 12.25, to_ras_mm(ball.vertices, "LPS"), ball.faces)
    kind, name, stamp, crc, body = split(message)
    assert (kind, name, stamp, crc) == ("POLYDATA", "tumour", 12.25, crc64(body))
    points, faces = surface(body)
    np.testing.assert_allclose(points, 1e3 * ball.vertices * [-1.0, -1.0, 1.0], rtol=1e-6)
    np.testing.assert_array_equal(faces, ball.faces)
    np.testing.assert_allclose(to_ras_mm(ball.vertices, "RAS"), 1e3 * ball.vertices, rtol=1e-6)


def test_surface_without_a_triangle_is_none():
    *_, body = split(pack_surface("a", 1.0, np.zeros((0, 3), np.float32), np.zeros((0, 3), int)))
    points, faces = surface(body)
    assert len(points) == len(faces) == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e38])
def test_coordinates_that_are_not_finite_are_refused(value):
    with pytest.raises(InvalidInputError, match="expected finite coordinates"):
        to_ras_mm(np.array([[0.0, value, 0.0]]), "LPS")


@pytest.mark.parametrize("system", ["LPS", "RAS"])
def test_transform_takes_ras_of_the_organ_to_the_camera(system):
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation([1.0, 2.0, 3.0], 0.7), [0.1, -0.2, 0.3]
    kind, name, _, crc, body = split(pack_transform("OrganToCamera", 3.0, motion, system))
    assert (kind, name, crc) == ("TRANSFORM", "OrganToCamera", crc64(body))
    # Columns of the rotation, then the translation (specification: R11 R21 R31 R12 ... TX TY TZ).
    columns = np.array(struct.unpack(">12f", body)).reshape(4, 3).T
    point = np.array([0.01, 0.02, -0.03])
    ras_mm = to_ras_mm(point[None], system)[0]
    there = columns[:, :3] @ ras_mm + columns[:, 3]
    np.testing.assert_allclose(there, 1e3 * (motion[:3, :3] @ point + motion[:3, 3]), rtol=1e-5)
    assert np.linalg.det(columns[:, :3]) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("text", ["OK", "DEGRADED: 'Läsion' … 5 mm", 5000 * "x", ""])
def test_text_is_ascii_and_read_by_pyigtl(text):
    kind, name, _, crc, body = split(pack_text("Status", 3.0, text))
    assert (kind, name, crc) == ("STRING", "Status", crc64(body))
    encoding, length = struct.unpack(">HH", body[:4])
    assert encoding == 3 and len(body) == 4 + length  # US-ASCII
    message = MessageBase.create_message("STRING")
    header = {"header_version": 1, "message_type": kind, "device_name": name, "timestamp": 3.0}
    message.unpack(header, body)
    assert message.string == "".join(c if ord(c) < 128 else "?" for c in text[:1000])


def test_names_of_devices_fit_the_header_and_differ():
    names = device_names(["a" * 40, "a" * 30, "b/c:d", " ", "Status"], ["Status"])
    assert names == ["a" * 20, "a" * 18 + " 2", "b_c_d", "structure", "Status 2"]
    assert all(len(name.encode()) <= 20 for name in names)
