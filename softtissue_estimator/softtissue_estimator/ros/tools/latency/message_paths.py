"""The message paths alone, in one process: ours beside naive versions that write the same."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import Organ, Structure, make_organ
from softtissue_estimator.ros.inputs.conversions import Cloud, read_cloud
from softtissue_estimator.ros.outputs.answer_buffer import AnswerBuffer
from softtissue_estimator.ros.outputs.markers import MarkerBuffer
from softtissue_estimator.ros.tools.latency import naive
from softtissue_estimator.ros.tools.latency.clouds import moving_clouds
from softtissue_estimator.ros.tools.latency.statistics import quantiles

FloatArray = NDArray[np.float64]

REPEATS, NAIVE_REPEATS = 50, 5
LIFETIME_S = 2.0
RING = (100, 100)
TRIANGLES = 2 * RING[0] * RING[1]
_STAMP_NS = 1_700_000_000_123_456_789


def read_serialised(data: bytes) -> Cloud:
    """Read a serialised cloud as the node does."""
    return read_cloud(deserialize_message(data, PointCloud2))


def time_cloud(organ: Organ, points: int) -> dict[str, Any]:
    """Time a serialised cloud of so many points to arrays."""
    data = next(iter(moving_clouds(organ, points, 1.0, 0.01, 1.0, 0)))
    return _row(
        "cloud to arrays", points, lambda: read_serialised(data), lambda: naive.read_cloud(data), _same_clouds
    )


def time_answer(organ: Organ) -> dict[str, Any]:
    """Time deformed vertices of all structures to the bytes of `~/deformed_points`."""
    positions, displacement = organ.query_points + 0.001, np.full_like(organ.query_points, 0.001)
    sigma = np.full(len(positions), 0.002)
    ours = AnswerBuffer(organ)
    return _row(
        "answer to bytes",
        len(organ.structure_points),
        lambda: ours.serialised(positions, displacement, sigma, _STAMP_NS),
        lambda: naive.answer(organ, positions, displacement, sigma, _STAMP_NS),
        _same_answers,
    )


def time_markers(publisher: Any) -> dict[str, Any]:
    """Time one mesh of 20,000 triangles from deformed vertices to publication; the publisher must be heard."""
    organ = ring_alone()
    positions = organ.query_points + 0.001
    ours = MarkerBuffer(organ)
    return _row(
        "markers published",
        TRIANGLES,
        lambda: publisher.publish(ours.serialised(positions, _STAMP_NS, LIFETIME_S)),
        lambda: publisher.publish(naive.markers(organ, positions, _STAMP_NS)),
    )


def ring_alone() -> Organ:
    """Return an organ whose markers are those of a single ring of 20,000 triangles: nothing is inside."""
    around, across = np.meshgrid(*(np.arange(n) for n in RING), indexing="ij")
    angle, tilt = 2.0 * np.pi * around / RING[0], 2.0 * np.pi * across / RING[1]
    radius = 0.05 + 0.02 * np.cos(tilt)
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.02 * np.sin(tilt)], axis=-1)
    number = around * RING[1] + across
    right, up = np.roll(number, -1, axis=0), np.roll(number, -1, axis=1)
    both = np.roll(right, -1, axis=1)
    faces = np.concatenate(
        [np.stack(t, axis=-1).reshape(-1, 3) for t in ((number, right, both), (number, both, up))]
    )
    structures: tuple[Structure, ...] = ()
    surface = SurfaceMesh(vertices.reshape(-1, 3), faces)
    return make_organ("Ring", "organ", surface, structures, np.zeros(len(surface.vertices), dtype=np.bool_))


def _row(
    path: str,
    size: int,
    ours: Callable[[], Any],
    simple: Callable[[], Any],
    same: Callable[[Any, Any], bool] = lambda a, b: True,
) -> dict[str, Any]:
    """Time both; `same` says whether the two results are, for a comparison of different things would be worthless."""
    equal = same(ours(), simple())
    # Alternating would warm and cool caches for each other: one after the other, as in a program.
    own, other = _times_ms(ours, REPEATS), _times_ms(simple, NAIVE_REPEATS)
    return {
        "path": path,
        "size": size,
        **quantiles(own, "ours_"),
        **quantiles(other, "naive_"),
        "naive_over_ours": round(float(np.median(other) / np.median(own)), 1),
        "same_result": equal,
    }


def _times_ms(work: Callable[[], Any], repeats: int) -> FloatArray:
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return 1e3 * np.array(seconds)


def _same_clouds(ours: Cloud, simple: tuple[FloatArray, FloatArray]) -> bool:
    reference = ours.reference
    return (
        reference is not None
        and np.array_equal(ours.points, simple[0])
        and np.array_equal(reference, simple[1])
    )


def _same_answers(ours: bytes, simple: bytes) -> bool:
    read, expected = (deserialize_message(data, PointCloud2) for data in (ours, simple))
    return bool(read.fields == expected.fields and read.data == expected.data)
