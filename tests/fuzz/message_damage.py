"""Messages and requests with values that nobody expects, all of them such as DDS can carry."""

import copy
import random
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2, PointField
from softtissue_msgs.msg import Correspondences
from softtissue_msgs.srv import DecideRegistration, Distance, LoadOrgan, Register, Reset, WarpPoints

from fuzz.damage import WHOLE_NUMBERS, damaged_bytes, how_often
from integration.scene import CAMERA_FROM_ORGAN, Scene, pose_message, registration_message, stamp_message

UNSIGNED = tuple(n for n in WHOLE_NUMBERS if 0 <= n < 2**32)
FLOATS = (
    0.0,
    1.0,
    -1.0,
    1e-320,
    1e-30,
    0.3,
    1e3,
    1e30,
    3e38,
    1e308,
    -1e308,
    float("nan"),
    float("inf"),
    float("-inf"),
)
_BYTES_SHARE = 0.25
_MOST_NUMBERS = 300_000
_NAMES = (
    "", "x", "y", "z", "id", "label", "organ_mask", "ref_x", "ref_y", "ref_z", "normal_x", "normal_y", "normal_z",
    "rgb", "X", "x" * 5000, "a\nb", "\x1b[2J", "\u202e",
)  # fmt: skip
FRAMES = ("organ", "camera", "endoscope", "", "/organ", "a" * 5000, "a\nb\x1b[2J", "\u202e\u2028", "ORGAN ")
_PATHS = (
    "", "/nowhere", "/proc/1", "/proc/self/mem", "/dev/zero", "x" * 300, "/a" * 3000, "~nosuchuser", "\x1b[2J", ".",
    "/", "..", "/tmp", "/etc/passwd", "organ.yaml", "\n", "//", "~",
)  # fmt: skip
PARAMETERS = (
    "default_sigma_m", "max_displacement_m", "max_reference_distance_m", "minimum_points", "minimum_visible_fraction",
    "maximum_rejected_fraction", "maximum_sigma_m", "frame_budget_s", "no_data_timeout_s", "organ", "organ_root",
    "estimator", "device", "use_sim_time", "matching", "organ_label", "tracking", "autostart", "nobody", "", "a\nb",
    "viewpoint", "registration_source",
)  # fmt: skip


def good_message(kind: str, scene: Scene, stamp: int = 10**18) -> list[Any]:
    """Messages of a kind as they should be."""
    if kind == "pair":
        return [scene.bare_cloud(stamp), scene.pairs(stamp)]
    return [
        {
            "cloud": lambda: scene.cloud(stamp),
            "bare": lambda: scene.bare_cloud(stamp),
            "normals": lambda: scene.cloud_with_normals(stamp),
            "camera_pose": lambda: _camera_pose(stamp),
            "registration": lambda: registration_message(CAMERA_FROM_ORGAN),
            "registration_with_covariance": lambda: pose_message(CAMERA_FROM_ORGAN, 1e-4 * np.eye(6)),
            "warp_points": lambda: WarpPoints.Request(points=[0.01, 0.0, 0.02, -0.01, 0.0, 0.0]),
            "distance": lambda: Distance.Request(tool=_tool()),
            "tool": _tool,
            "load_organ": lambda: LoadOrgan.Request(folder="/nowhere"),
            "reset": Reset.Request,
            "register": _register,
            "decide_registration": lambda: DecideRegistration.Request(decision=1),
            "parameters": lambda: SetParameters.Request(parameters=[Parameter(name="frame_budget_s")]),
        }[kind]()
    ]


def _register() -> Register.Request:
    # Landmarks that no organ has: it is not searched for, which takes seconds.
    return Register.Request(landmarks=["nowhere"] * 3, landmark_points=[0.0] * 9)


def _tool() -> PoseStamped:
    """A tool above the organ, that does not move: its stamp is zero."""
    tool = PoseStamped()
    tool.header.frame_id = "organ"
    tool.pose.position.z, tool.pose.orientation.x = 0.08, 1.0
    return tool


def _camera_pose(stamp: int) -> TransformStamped:
    message = registration_message(CAMERA_FROM_ORGAN, "camera", "endoscope")
    message.header.stamp = stamp_message(stamp)
    return message


def damaged_message(rng: random.Random, kind: str, scene: Scene) -> list[Any]:
    """Messages of a kind with some values changed."""
    messages = good_message(kind, scene, rng.randrange(1, 2**31 - 1) * 10**9 + rng.randrange(10**9))
    for _ in range(how_often(rng)):
        changed(rng, rng.choice(messages))
    return messages


def changed(rng: random.Random, message: Any) -> None:
    """Change some value of a message."""
    _CHANGES[type(message)](rng, message)


def serialised(rng: random.Random, messages: list[Any]) -> list[bytes]:
    """Serialise messages; some of the bytes of one of them may be damaged."""
    parts = [serialize_message(message) for message in messages]
    if rng.random() < _BYTES_SHARE:
        at = rng.randrange(len(parts))
        parts[at] = parts[at][:4] + damaged_bytes(rng, parts[at][4:])
    return parts


def deserialised(parts: list[bytes], types: list[Any]) -> list[Any] | None:
    """Undo `serialised`; None where the middleware leaves such bytes, whose error is counted (`BoundedExecutor`)."""
    try:
        return [deserialize_message(data, type_of) for data, type_of in zip(parts, types, strict=True)]
    except Exception:
        return None


def changed_header(rng: random.Random, header: Any) -> None:
    """Change stamp or frame."""
    if rng.random() < 0.5:
        header.stamp = Time(
            sec=rng.choice((0, 1, -1, 200, 2**31 - 1, -(2**31))),
            nanosec=rng.choice((0, 1, 10**9 - 1, 10**9, 2**32 - 1)),
        )
    else:
        header.frame_id = rng.choice(FRAMES)


def _cloud(rng: random.Random, cloud: PointCloud2) -> None:
    what = rng.randrange(8)
    if what == 0:
        changed_header(rng, cloud.header)
    elif what == 1:
        setattr(cloud, rng.choice(("width", "height", "point_step", "row_step")), _near(rng, cloud))
    elif what == 2:
        name = rng.choice(("is_bigendian", "is_dense"))
        setattr(cloud, name, not getattr(cloud, name))
    elif what == 3:
        _fields(rng, cloud)
    elif what == 4:
        cloud.data = damaged_bytes(rng, bytes(cloud.data))
    elif what == 5:
        cloud.height, cloud.width = rng.choice(
            ((2, cloud.width // 2), (cloud.width, 1), (1, cloud.width * 2))
        )
    else:
        values = np.frombuffer(bytes(cloud.data)[: len(cloud.data) // 4 * 4], dtype="<f4").copy()
        if len(values):
            share = rng.choice((0.001, 0.1, 1.0))
            chosen = np.random.default_rng(rng.getrandbits(32)).random(len(values)) < share
            with np.errstate(over="ignore"):
                values[chosen] = np.float32(rng.choice(FLOATS))
            cloud.data = values.tobytes()


def _near(rng: random.Random, cloud: PointCloud2) -> int:
    true = rng.choice((cloud.width, cloud.point_step, cloud.row_step, len(cloud.data)))
    return rng.choice((*UNSIGNED, true, true + 1, max(true - 1, 0), min(2 * true, 2**32 - 1)))


def _fields(rng: random.Random, cloud: PointCloud2) -> None:
    fields = list(cloud.fields)
    at, what = rng.randrange(max(1, len(fields))), rng.randrange(7)
    if not fields or what == 0:
        fields.append(PointField(name=rng.choice(_NAMES), offset=0, datatype=7, count=1))
    elif what == 1:
        del fields[at]
    elif what == 2:
        fields[at].name = rng.choice(_NAMES)
    elif what == 3:
        fields[at].offset = rng.choice((*UNSIGNED, 20, 21, 24))
    elif what == 4:
        fields[at].datatype = rng.choice((0, 1, 2, 5, 6, 7, 8, 9, 255))
    elif what == 5:
        fields[at].count = rng.choice(UNSIGNED)
    else:
        fields *= rng.choice((2, 50))
    cloud.fields = [copy.deepcopy(field) for field in fields[:500]]


def _pairs(rng: random.Random, pairs: Correspondences) -> None:
    what, entries = rng.randrange(5), len(pairs.reference) // 3
    if what == 0:
        changed_header(rng, pairs.header)
    elif what == 1:
        reference = list(pairs.reference)
        if reference:
            reference[rng.randrange(len(reference))] = _as_float32(rng)
        pairs.reference = reference[: rng.choice((len(reference), 0, 1, 4, len(reference) - 3))] * rng.choice(
            (1, 1, 2)
        )
    elif what == 2:
        index = rng.choice((list(range(entries)), [0] * entries, list(range(entries))[::-1], [entries], []))
        if index and rng.random() < 0.5:
            index[rng.randrange(len(index))] = rng.choice(UNSIGNED)
        pairs.index = index
    elif what == 3:
        sigma = [0.002] * rng.choice((entries, entries, 1, 0, entries + 1))
        if sigma:
            sigma[rng.randrange(len(sigma))] = _as_float32(rng)
        pairs.sigma = sigma
    else:
        pairs.header.frame_id = rng.choice(FRAMES)


def _as_float32(rng: random.Random) -> float:
    with np.errstate(over="ignore"):
        return float(np.float32(rng.choice(FLOATS)))


def _registration(rng: random.Random, message: TransformStamped) -> None:
    if rng.random() < 0.2:
        changed_header(rng, message.header)
    elif rng.random() < 0.3:
        message.child_frame_id = rng.choice(FRAMES)
    else:
        part, axis = rng.choice((("translation", "xyz"), ("rotation", "xyzw")))
        setattr(getattr(message.transform, part), rng.choice(axis), rng.choice(FLOATS))


def _pose(rng: random.Random, message: PoseWithCovarianceStamped) -> None:
    if rng.random() < 0.2:
        changed_header(rng, message.header)
    elif rng.random() < 0.3:
        part, axis = rng.choice((("position", "xyz"), ("orientation", "xyzw")))
        setattr(getattr(message.pose.pose, part), rng.choice(axis), rng.choice(FLOATS))
    else:
        covariance, value = np.array(message.pose.covariance).reshape(6, 6), rng.choice(FLOATS)
        row, column = rng.randrange(6), rng.randrange(6)
        covariance[row, column] = value
        if rng.random() < 0.7:
            covariance[column, row] = value
        message.pose.covariance = covariance.ravel()


def _distance(rng: random.Random, request: Distance.Request) -> None:
    _tool_pose(rng, request.tool)


def _tool_pose(rng: random.Random, tool: PoseStamped) -> None:
    if rng.random() < 0.3:
        changed_header(rng, tool.header)
        return
    part, axis = rng.choice((("position", "xyz"), ("orientation", "xyzw")))
    setattr(getattr(tool.pose, part), rng.choice(axis), rng.choice((*FLOATS, 0.02, -0.04)))


def _warp(rng: random.Random, request: WarpPoints.Request) -> None:
    if rng.random() < 0.3:
        changed_header(rng, request.header)
        return
    times = rng.choice((1, 1, 1, 100, 2000))
    points = list(request.points)
    points = (points * min(times, 1 + _MOST_NUMBERS // max(1, len(points))))[:_MOST_NUMBERS]
    points = points[: rng.choice((len(points), len(points), 0, 1, 4))]
    if points:
        points[rng.randrange(len(points))] = rng.choice(FLOATS)
    request.points = points


def _start(rng: random.Random, request: Register.Request) -> None:
    what = rng.randrange(4)
    if what == 0:
        stamped = PoseWithCovarianceStamped(pose=request.start)
        _pose(rng, stamped)
        request.start, request.use_start = stamped.pose, True
    elif what == 1:
        request.landmarks = [rng.choice(FRAMES) for _ in range(rng.choice((1, 3, 200)))]
    elif what == 2:
        request.landmark_points = [rng.choice(FLOATS) for _ in range(rng.choice((0, 1, 9, 600)))]
    else:
        request.apply, request.use_start = rng.random() < 0.5, rng.random() < 0.5


def _decision(rng: random.Random, request: DecideRegistration.Request) -> None:
    request.decision = rng.choice((0, 1, 2, 3, 4, 255))


def _load(rng: random.Random, request: LoadOrgan.Request) -> None:
    request.folder = rng.choice(_PATHS[1:])  # the empty one is the bundled organ


def _parameters(rng: random.Random, request: SetParameters.Request) -> None:
    value = ParameterValue(type=rng.choice((*range(10), 3, 3, 3, 10, 77, 255)))
    value.bool_value, value.integer_value = rng.random() < 0.5, rng.choice((0, 1, -1, 5, 2**63 - 1, -(2**63)))
    value.double_value, value.string_value = rng.choice(FLOATS), rng.choice(_PATHS)
    value.double_array_value, value.string_array_value = [rng.choice(FLOATS)], [rng.choice(_PATHS)]
    request.parameters = [*request.parameters, Parameter(name=rng.choice(PARAMETERS), value=value)][
        -rng.choice((1, 3)) :
    ]


_CHANGES = {
    PointCloud2: _cloud,
    Correspondences: _pairs,
    TransformStamped: _registration,
    PoseWithCovarianceStamped: _pose,
    WarpPoints.Request: _warp,
    Distance.Request: _distance,
    PoseStamped: _tool_pose,
    LoadOrgan.Request: _load,
    Reset.Request: lambda _rng, _request: None,
    Register.Request: _start,
    DecideRegistration.Request: _decision,
    SetParameters.Request: _parameters,
}
