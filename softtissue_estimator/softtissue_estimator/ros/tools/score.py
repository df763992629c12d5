"""Executable `score`: listens to a replayed bag and the node's answers, and prints frames, latency and TRE."""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError, MissingDependencyError
from softtissue_estimator.ros.runtime import Spinner, StopRequest, run_tool
from softtissue_estimator.ros.tools.kept import KeptView, Snapshot
from softtissue_estimator.ros.tools.scoring import Record, failures, make_report, table

FloatArray = NDArray[np.float64]

QUEUE = 200
# After this long without anything new, frames that are still open will not be answered any more, s.
SETTLE_S = 10.0
MATCH_S = 0.3


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        prog="score",
        description="Listen to surface_points, markers_truth and the node's answers until the clouds' publisher"
        " is gone; print the table. Exit code 1 if clouds went unanswered uncounted or the error did not fall.",
    )
    parser.add_argument(
        "--node", default="softtissue_estimator", help="name of the node (default softtissue_estimator)"
    )
    parser.add_argument("--report", type=Path, help="write the figures to this JSON file")
    parser.add_argument("--snapshot", type=Path, help="write the estimate of one frame to this .npz file")
    parser.add_argument(
        "--snapshot-stamp", type=int, default=0, help="… of the first with this stamp (ns) or later"
    )
    parser.add_argument("--organ", type=Path, help="… at all vertices of this organ (folder)")
    parser.add_argument(
        "--view", type=Path, help="write one answer as the overlay draws it to this .npz file"
    )
    parser.add_argument(
        "--view-stamps",
        type=int,
        nargs="+",
        default=[],
        metavar="NS",
        help="… of the first of these stamps with one",
    )
    parser.add_argument("--title", default="score", help="heading of the table")
    options = parser.parse_args(arguments)
    if options.snapshot is not None and options.organ is None:
        parser.error("--snapshot: expected --organ too, got none")
    return options


class Listener:
    """Subscriptions and the client of `~/warp_points`; callbacks run in the spinning thread.

    Parameters
    ----------
    node : rclpy.node.Node
    name : str
        Name of the node under test.
    snapshot : Snapshot, optional
    view : KeptView, optional
    """

    def __init__(self, node: Any, name: str, snapshot: Snapshot | None, view: KeptView | None = None) -> None:
        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import CameraInfo, PointCloud2
        from softtissue_msgs.msg import EstimatorStatus
        from softtissue_msgs.srv import WarpPoints

        self.record = Record()
        self.last_news_s = time.monotonic()
        self.problem: str | None = None
        self._snapshot, self._view = snapshot, view
        self.camera_info: Any = None
        self._node, self._request = node, WarpPoints.Request
        self._client = node.create_client(WarpPoints, f"{name}/warp_points")
        self._qos = QoSProfile(depth=QUEUE)
        self._answers = [
            node.create_subscription(EstimatorStatus, f"{name}/status", self._on_status, self._qos, raw=True),
            node.create_subscription(PointCloud2, f"{name}/deformed_points", self._on_answer, self._qos),
        ]
        node.create_subscription(PointCloud2, "markers_truth", self._on_truth, self._qos)
        node.create_subscription(CameraInfo, "camera_info", self._on_camera, self._qos)
        if view is not None:
            node.create_subscription(
                PointCloud2, f"{name}/deformed_surface", lambda m: view.take(m, surface=True), self._qos
            )
        self._listen_to_poses(name)
        self._clouds: Any = None

    def _listen_to_poses(self, name: str) -> None:
        """Hear where the node has the organ, and where it truly is, if that is told for a room with a moving camera."""
        from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped

        from softtissue_estimator.ros.inputs.registration import Registration

        self._truth = Registration()
        self._organ_frame = ""

        def take_organ(message: Any) -> None:
            self._truth.put(message)
            self._organ_frame = message.child_frame_id

        topics = {"organ_pose_truth": take_organ, "camera_pose": self._truth.cameras.put}
        for topic, take in topics.items():
            self._node.create_subscription(TransformStamped, topic, self._told(topic, take), self._qos)
        self._node.create_subscription(
            PoseWithCovarianceStamped, f"{name}/registration", self._on_pose, self._qos
        )

    def _told(self, topic: str, take: Callable[[Any], None]) -> Callable[[Any], None]:
        def on_message(message: Any) -> None:
            try:
                take(message)
            except InvalidInputError as error:
                self.problem = f"{topic}: {error}"

        return on_message

    def _on_pose(self, message: Any) -> None:
        from softtissue_estimator.ros.inputs.conversions import read_pose, stamp_ns

        stamp = stamp_ns(message.header.stamp)
        if not self._organ_frame:
            return
        try:
            pose = self._truth.pose(message.header.frame_id, self._organ_frame, stamp)
            self.record.fitted[stamp] = read_pose(message)
        except InvalidInputError as error:
            self.problem = f"organ_pose_truth: {error}"
            return
        self.record.true_pose[stamp] = pose.motion

    def connected(self) -> bool:
        """Say whether the node's answers will be heard."""
        heard = all(subscription.get_publisher_count() > 0 for subscription in self._answers)
        return heard and bool(self._client.service_is_ready())

    def listen(self) -> None:
        """Subscribe to the clouds; a replay that waits for this subscriber begins."""
        from sensor_msgs.msg import PointCloud2

        # Only the time of publication is of interest, so the cloud is not deserialised.
        self._clouds = self._node.create_subscription(
            PointCloud2, "surface_points", self._on_cloud, self._qos, raw=True
        )

    def finished(self) -> bool:
        """Say whether the clouds' publisher is gone and nothing more will come."""
        if not self.record.sent_ns or self._node.count_publishers(self._clouds.topic_name) > 0:
            return False
        quiet = time.monotonic() - self.last_news_s
        return quiet > (1.0 if self.record.unaccounted == 0 else SETTLE_S)

    def _on_cloud(self, data: bytes, info: dict[str, Any]) -> None:
        from softtissue_estimator.ros.outputs.serialised import read_stamp

        self.last_news_s = time.monotonic()
        self.record.sent_ns[read_stamp(data)] = int(info["source_timestamp"])

    def _on_answer(self, message: Any) -> None:
        from softtissue_estimator.ros.inputs.conversions import stamp_ns

        now = time.time_ns()
        self.last_news_s = time.monotonic()
        stamp = stamp_ns(message.header.stamp)
        self.record.answered_ns[stamp] = now
        if self._view is not None:
            self._view.take(message)
        if not self._client.service_is_ready():
            return
        if self.record.reference is not None:
            self._warp(self.record.reference, self._take_markers)
        snapshot = self._snapshot
        if snapshot is not None and not snapshot.asked and stamp >= snapshot.stamp_ns:
            snapshot.asked = True
            markers = self.record.reference
            points = snapshot.points if markers is None else np.concatenate([snapshot.points, markers])
            self._warp(points, snapshot.take)

    def _warp(self, points: FloatArray, take: Callable[[int, FloatArray, FloatArray], None]) -> None:
        """Ask where preoperative points (m, organ frame) are now; `take` gets stamp, positions and sigma."""
        from softtissue_estimator.ros.inputs.conversions import doubles, stamp_ns

        def on_response(future: Any) -> None:
            response = future.result()
            self.last_news_s = time.monotonic()
            if response is not None and response.result == response.SUCCESS:
                # The stamp says which cloud the estimate was made from, whichever answer prompted the question.
                sigma = np.asarray(response.sigma, dtype=np.float64)
                take(stamp_ns(response.header.stamp), np.asarray(response.points).reshape(-1, 3), sigma)

        self._client.call_async(self._request(points=doubles(points))).add_done_callback(on_response)

    def _take_markers(self, stamp: int, points: FloatArray, sigma: FloatArray) -> None:
        self.record.estimate[stamp] = points
        if np.isfinite(sigma).all():
            self.record.sigma[stamp] = sigma

    def _on_camera(self, message: Any) -> None:
        self.camera_info = message

    def use_camera(self) -> None:
        """Let the score compare markers on the image, if a camera was told of and OpenCV is installed."""
        if self.camera_info is None:
            return
        try:
            from softtissue_estimator.ros.inputs.images import read_camera

            camera = read_camera(self.camera_info, rectified=False)
        except MissingDependencyError:
            return  # an extra: the rest is scored without it
        except InvalidInputError as error:
            self.problem = f"camera_info: {error}"
            return
        self.record.project, self.record.shows = camera.project, camera.shows

    def _on_truth(self, message: Any) -> None:
        from softtissue_estimator.ros.inputs.conversions import read_cloud

        try:
            cloud = read_cloud(message)
        except InvalidInputError as error:
            self.problem = f"markers_truth: {error}"
            return
        if cloud.reference is None:
            self.problem = "markers_truth: expected fields ref_x ref_y ref_z, got none of them"
            return
        self.record.reference = np.asarray(cloud.reference, dtype=np.float64)
        self.record.truth[cloud.stamp_ns] = np.asarray(cloud.points, dtype=np.float64)

    def _on_status(self, data: bytes) -> None:
        from rclpy.serialization import deserialize_message
        from softtissue_msgs.msg import EstimatorStatus

        try:
            message = deserialize_message(data, EstimatorStatus)
        except Exception:  # rclpy's own
            self.problem = "status: expected EstimatorStatus as it is installed, got bytes of something else"
            return
        self.last_news_s = time.monotonic()
        self.record.dropped, self.record.refused = int(message.frames_dropped), int(message.frames_refused)
        if message.level != message.INVALID:
            for name, seconds in zip(message.stage_names, message.stage_seconds, strict=True):
                self.record.stages.setdefault(name, []).append(float(seconds))


def run(options: argparse.Namespace, stop: StopRequest) -> int:
    """Listen and print; return the exit code."""
    import rclpy

    from softtissue_estimator.organ.organ import load_organ

    node = rclpy.create_node("score")
    snapshot = None
    if options.snapshot is not None:
        snapshot = Snapshot(load_organ(options.organ).query_points, options.snapshot_stamp)
    view = None if options.view is None else KeptView(options.view_stamps)
    listener = Listener(node, options.node, snapshot, view)
    spinner = Spinner(node, lambda error: stop.stop(1))
    while not stop.event.wait(0.1) and not listener.connected():
        pass
    # Both sides of a match come into effect a little apart.
    stop.event.wait(MATCH_S)
    listener.listen()
    while not stop.event.wait(0.1) and not listener.finished():
        pass
    spinner.stop(2.0)
    node.destroy_node()
    listener.use_camera()
    report = make_report(listener.record)
    print(table(report, options.title), flush=True)
    if options.report is not None:
        options.report.write_text(json.dumps(report, indent=2) + "\n")
    if snapshot is not None:
        snapshot.write(options.snapshot)
    if view is not None:
        view.write(options.view, listener.record)
    problems = failures(report) + ([listener.problem] if listener.problem else [])
    for problem in problems:
        print(f"error: {problem}", file=sys.stderr)
    return stop.exit_code or (1 if problems else 0)


def main() -> None:
    """Run the executable."""
    run_tool(parse, run)


if __name__ == "__main__":
    main()
