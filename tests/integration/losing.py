"""Cut the organ out of the bundled scene's clouds for a while: when the node notices, and when it finds it again.

As a program: `scripts/run --alone python tests/integration/losing.py --source auto`; figures go to out/losing.json.
What is left of a cloud in the meantime is what lies around the organ: wall, stomach, fat and instruments.
"""

import argparse
import json
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import EstimatorStatus

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

from integration.harness import NodeProcess, PlainClient
from integration.scene import nanoseconds
from ros_domain import reserved
from softtissue_estimator.ros.tools.bag import Bag
from softtissue_estimator.support.resources import bundled_organ, bundled_scene

STEP_S = 60.0  # within which a cloud is answered however busy the machine is
SETTLE_S = 3.0  # after the last cloud, within which what is late is still heard


@dataclass(frozen=True)
class Figures:
    """Seconds by the clouds' stamps; None for what did not come.

    Attributes
    ----------
    first_answer_s : float or None
        From the first cloud to the first answer.
    noticed_s : float or None
        From the first cloud without the organ to the first that is INVALID, and no answer after it.
    found_again_s : float or None
        From the first cloud with the organ again to the first answer after it.
    answered_without : int
        Clouds without the organ that were answered.
    reasons : list of str
        Of the clouds without it.
    """

    first_answer_s: float | None
    noticed_s: float | None
    found_again_s: float | None
    answered_without: int
    reasons: list[str]


def without_organ(cloud: PointCloud2, labels: np.ndarray) -> PointCloud2:
    """Return a cloud without the points that are labelled as the organ's, 0."""
    data = np.frombuffer(bytes(cloud.data), dtype=np.uint8).reshape(-1, cloud.point_step)[labels != 0]
    left = PointCloud2(header=cloud.header, fields=cloud.fields, is_bigendian=cloud.is_bigendian)
    left.height, left.width, left.point_step = 1, len(data), cloud.point_step
    left.row_step, left.is_dense, left.data = data.size, cloud.is_dense, data.tobytes()
    return left


def scene_messages() -> list[tuple[float, str, object]]:
    """Return time (s), topic and message of the scene, with the labels of each cloud's points."""
    kinds = {
        "/surface_points": PointCloud2,
        "/surface_labels_truth": PointCloud2,
        "/camera_pose": TransformStamped,
        "/organ_pose_truth": TransformStamped,
    }
    with Bag(bundled_scene()) as bag:
        return [
            (1e-9 * (at - bag.start_ns), connection.topic, deserialize_message(data, kinds[connection.topic]))
            for connection, at, data in bag.messages()
            if connection.topic in kinds
        ]


def run(
    source: str, begin_s: float, end_s: float, folder: Path, last_s: float = 10.0, *, step: bool = False
) -> Figures:
    """Play the scene to a node; its clouds are without the organ from `begin_s` to `end_s`.

    With `step` each cloud waits for the status of the one before, so that a busy machine changes nothing.
    """
    messages = [message for message in scene_messages() if message[0] <= last_s]
    labels = {
        nanoseconds(m.header.stamp): np.frombuffer(bytes(m.data), dtype=np.uint8)[:: m.point_step]
        for _, topic, m in messages
        if topic == "/surface_labels_truth"
    }
    parameters = {"organ": bundled_organ(), "registration_source": source}
    with reserved() as domain, NodeProcess(domain, folder, parameters), PlainClient(domain) as client:
        statuses: list[EstimatorStatus] = []
        client.node.create_subscription(EstimatorStatus, f"{client.name}/status", statuses.append, 200)
        publishers = {
            "/surface_points": client.node.create_publisher(PointCloud2, "surface_points", 10),
            "/camera_pose": client.node.create_publisher(
                TransformStamped, "camera_pose", QoSProfile(depth=100)
            ),
        }
        if source == "given":
            publishers["/organ_pose_truth"] = client.node.create_publisher(
                TransformStamped, "registration", 10
            )
        client.wait(publishers["/surface_points"].get_subscription_count, "active node", 120.0)
        client.spin(0.5)
        began, without = time.monotonic(), []
        for at_s, topic, message in messages:
            if topic not in publishers:
                continue
            client.spin(0.01 if step else max(0.0, began + at_s - time.monotonic()))
            if topic == "/surface_points" and begin_s <= at_s < end_s:
                without.append(nanoseconds(message.header.stamp))
                message = without_organ(message, labels[without[-1]])
            said = len(statuses)
            publishers[topic].publish(message)
            if step and topic == "/surface_points":
                client.wait(lambda said=said: len(statuses) > said, "status of a cloud", STEP_S)
        client.spin(0.0 if step else SETTLE_S)
    clouds = [nanoseconds(m.header.stamp) for _, topic, m in messages if topic == "/surface_points"]
    return figures(statuses, clouds, without)


def figures(statuses: list[EstimatorStatus], clouds: list[int], without: list[int]) -> Figures:
    """Count from what the node said of clouds with these stamps, of which some were without the organ."""
    said = {nanoseconds(status.header.stamp): status for status in statuses}
    answered = [stamp for stamp in clouds if stamp in said and said[stamp].level != EstimatorStatus.INVALID]
    wrong = [stamp for stamp in answered if stamp in set(without)]
    silent = [stamp for stamp in without if stamp in said and stamp > max(wrong, default=0)]
    again = [stamp for stamp in answered if without and stamp > without[-1]]
    back = [stamp for stamp in clouds if without and stamp > without[-1]]
    return Figures(
        1e-9 * (answered[0] - clouds[0]) if answered else None,
        1e-9 * (silent[0] - without[0]) if silent else None,
        1e-9 * (again[0] - back[0]) if again else None,
        len(wrong),
        sorted({said[stamp].reason for stamp in silent}),
    )


def main() -> None:
    """Run as a program."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--source", choices=("given", "auto"), default="given", help="registration_source")
    parser.add_argument(
        "--begin", type=float, default=6.5, help="organ cut out from here on, s (default 6.5)"
    )
    parser.add_argument("--end", type=float, default=8.5, help="organ back, s (default 8.5)")
    parser.add_argument("--out", type=Path, default=Path("out/losing.json"))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = asdict(run(options.source, options.begin, options.end, Path(folder)))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
