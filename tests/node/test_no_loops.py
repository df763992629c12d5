"""No Python runs per point, per vertex or per triangle: as many lines are executed for many as for few."""

import sys
import tracemalloc
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

import trimesh

from integration.harness import write_organ
from integration.scene import Scene
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.observation.observation import make_observation
from softtissue_estimator.observation.rigid import transform_points
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.ros.inputs.conversions import read_cloud
from softtissue_estimator.ros.outputs.answer_buffer import AnswerBuffer
from softtissue_estimator.ros.outputs.markers import MarkerBuffer
from softtissue_estimator.ros.questions import tracked_points


def executed(work):
    """Lines that our own modules execute in `work`, by module and number."""
    lines = Counter()

    def trace(frame, event, _argument):
        name = frame.f_code.co_filename
        if "softtissue_estimator" not in name:
            return None
        if event == "line":
            lines[name.rpartition("/")[2], frame.f_lineno] += 1
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)
    assert lines
    return lines


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_organ(tmp_path_factory.mktemp("organ"))


@pytest.mark.parametrize("with_pairs", [False, True])
def test_taking_a_cloud_in(folder, with_pairs):
    config = EstimatorConfig()

    def take_in(points):
        scene = Scene(folder, points=points)
        organ = scene.organ
        assert organ.surface_lookup, "made once an organ"
        cloud = scene.bare_cloud(0) if with_pairs else scene.cloud(0)
        pairs = scene.pairs(0) if with_pairs else None

        def work():
            read = read_cloud(cloud)
            points, reference, sigma, _ = tracked_points(pairs, read, organ.frame)
            make_observation(transform_points(np.eye(4), points), reference, sigma, organ, config)

        work()  # what libraries and caches do the first time
        return executed(work)

    assert take_in(500) == take_in(20_000)


def sphere(subdivisions):
    """An organ that consists of a sphere in a sphere."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    surface = SurfaceMesh(np.array(mesh.vertices), np.array(mesh.faces))
    return SimpleNamespace(
        name="ball",
        frame="organ",
        surface=surface,
        structures=(SimpleNamespace(name="core", mesh=surface, colour=(1.0, 0.0, 0.0, 1.0)),),
        structure_points=surface.vertices,
        structure_index=np.zeros(len(surface.vertices), dtype=np.uint32),
        query_points=np.concatenate([surface.vertices, surface.vertices]),
    )


def messages(organ):
    points, markers = AnswerBuffer(organ), MarkerBuffer(organ)
    moved, sigma = organ.query_points + 0.01, np.full(len(organ.query_points), 0.001)

    def work():
        return points.serialised(moved, moved - organ.query_points, sigma, 1), markers.serialised(
            moved, 1, 2.0
        )

    work()
    return work


def test_sending_an_answer():
    assert executed(messages(sphere(2))) == executed(messages(sphere(5)))


def test_an_answer_takes_as_many_allocations_whatever_its_size():
    def allocations(work):
        tracemalloc.start()
        try:
            before = tracemalloc.take_snapshot()
            kept = work()
            after = tracemalloc.take_snapshot()
        finally:
            tracemalloc.stop()
        assert kept
        return sum(
            max(0, entry.count_diff)
            for entry in after.compare_to(before, "filename")
            if "tracemalloc" not in str(entry.traceback)
        )

    few, many = allocations(messages(sphere(2))), allocations(messages(sphere(5)))
    assert many <= few + 20
