"""What the viewer takes: memory and processor at 20 answers a second, without a page and with one in Chromium.

Usage: scripts/run --alone python tests/integration/viewer_load.py [MINUTES]        (each, default 2)
"""

import os
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from playwright.sync_api import sync_playwright
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import EstimatorStatus, Structures

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

from integration.harness import AtRate, NodeProcess, PlainClient, executable
from integration.scene import cloud_message
from integration.test_viewer import ESTIMATOR, KEPT, SOFTWARE, S, table
from ros_domain import reserved
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.ros.inputs.conversions import time_message
from softtissue_estimator.ros.outputs.structures import structures_message
from softtissue_estimator.support.resources import bundled_organ

RATE_HZ, POINTS, SAMPLE_S = 20.0, 4000, 15.0


class Player:
    """Publishes what a node would on the bundled organ, which swings by 10 mm."""

    def __init__(self, client):
        publish, organ = client.node.create_publisher, load_organ(bundled_organ())
        self.inside = np.concatenate([structure.mesh.vertices for structure in organ.structures])
        self.surface, self.number = organ.surface.vertices, 0
        self.clouds = publish(PointCloud2, "surface_points", 10)
        self.poses = publish(PoseWithCovarianceStamped, f"{ESTIMATOR}/registration", 10)
        self.points = publish(PointCloud2, f"{ESTIMATOR}/deformed_points", 10)
        self.surfaces = publish(PointCloud2, f"{ESTIMATOR}/deformed_surface", 10)
        self.statuses = publish(EstimatorStatus, f"{ESTIMATOR}/status", KEPT)
        self.structures = publish(Structures, f"{ESTIMATOR}/structures", KEPT)
        self.structures.publish(structures_message(organ))

    def answer(self):
        self.number += 1
        stamp = 1000 * S + int(self.number * S / RATE_HZ)
        moved = np.array([0.01 * np.sin(self.number / 20.0), 0.0, 0.0])
        seen = np.resize(self.surface, (POINTS, 3)) + np.array([0.0, 0.0, 0.3])
        self.clouds.publish(cloud_message(seen, ["x", "y", "z"], stamp, "eye"))
        pose = PoseWithCovarianceStamped()
        pose.header.frame_id, pose.header.stamp = "eye", time_message(stamp)
        pose.pose.pose.orientation.w, pose.pose.pose.position.z = 1.0, 0.3
        self.poses.publish(pose)
        self.points.publish(table(self.inside + moved, stamp))
        self.surfaces.publish(table(self.surface + moved, stamp))
        self.statuses.publish(EstimatorStatus(total_seconds=0.04, visible_fraction=0.2))


def usage(process):
    """Seconds of the processor and megabytes of memory that a process has taken."""
    times = Path(f"/proc/{process}/stat").read_text().rsplit(") ", 1)[1].split()
    status = Path(f"/proc/{process}/status").read_text().splitlines()
    (resident,) = (line.split()[1] for line in status if line.startswith("VmRSS"))
    return (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK"), int(resident) / 1024.0


def watch(what, viewer, player, seconds):
    """Print what the viewer takes every so often."""
    begin, first = time.monotonic(), player.number
    then, spent = begin, usage(viewer.process.pid)[0]
    while time.monotonic() - begin < seconds:
        time.sleep(SAMPLE_S)
        now, (total, memory) = time.monotonic(), usage(viewer.process.pid)
        print(
            f"{what}, {now - begin:4.0f} s: {memory:6.1f} MB,"
            f" {100.0 * (total - spent) / (now - then):5.1f} % of a core,"
            f" {(player.number - first) / (now - begin):.1f} answers a second",
            flush=True,
        )
        then, spent = now, total


def main():
    seconds = 60.0 * float(sys.argv[1] if len(sys.argv) > 1 else 2.0)
    folder = Path(tempfile.mkdtemp(prefix="viewer_load_"))
    program = [executable("viewer")]
    with (
        reserved() as domain,
        NodeProcess(domain, folder, {"port": 0}, program) as viewer,
        PlainClient(domain) as client,
    ):
        viewer.wait_for_text("serving ")
        address = viewer.text.partition("serving ")[2].split()[0]
        player = Player(client)
        with AtRate(player.answer, RATE_HZ):
            watch("no page", viewer, player, seconds)
            with sync_playwright() as started:
                browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=SOFTWARE)
                browser.new_page(viewport={"width": 1000, "height": 640}).goto(address)
                watch("one page", viewer, player, seconds)
                browser.close()
        viewer.stop(signal.SIGINT)
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()
