"""How long the node's parameters and services take to answer, while it estimates."""

import threading
import time
from typing import Any

import numpy as np

from softtissue_estimator.ros.tools.latency.statistics import quantiles

PERIOD_S = 0.1
TIMEOUT_S = 5.0
POINTS = 100


class Probe:
    """Asks for parameters and for warped points, ten times a second, until it is stopped.

    Parameters
    ----------
    node : rclpy.node.Node
        Spun by another thread.
    name : str
        Name of the node under test.
    points : (n, 3) float64
        Preoperative points to warp, m, organ frame; the first 100 are used.
    """

    def __init__(self, node: Any, name: str, points: Any) -> None:
        from rcl_interfaces.srv import GetParameters
        from softtissue_msgs.srv import WarpPoints

        from softtissue_estimator.ros.inputs.conversions import doubles

        warp = WarpPoints.Request(points=doubles(points[:POINTS]))
        self._questions = {
            "get_parameters": (
                node.create_client(GetParameters, f"{name}/get_parameters"),
                GetParameters.Request(names=["estimator", "frame_budget_s"]),
            ),
            "warp_points": (node.create_client(WarpPoints, f"{name}/warp_points"), warp),
        }
        self._node = node
        self._seconds: dict[str, list[float]] = {what: [] for what in self._questions}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="probe", daemon=True)
        self._thread.start()

    def stop(self) -> dict[str, Any]:
        """Stop asking; return the response times of each service, ms, and how often it was asked."""
        self._stop.set()
        self._thread.join()
        for client, _ in self._questions.values():
            self._node.destroy_client(client)
        return {
            what: {"calls": len(seconds), **quantiles(1e3 * np.array(seconds))}
            for what, seconds in self._seconds.items()
        }

    def _run(self) -> None:
        while not self._stop.wait(PERIOD_S):
            for what, (client, request) in self._questions.items():
                if not client.service_is_ready():
                    continue
                done = threading.Event()
                began = time.monotonic()
                future = client.call_async(request)
                future.add_done_callback(lambda _, done=done: done.set())
                done.wait(TIMEOUT_S)
                # One that never answers counts as long as it was waited for.
                self._seconds[what].append(time.monotonic() - began)
