"""What is raised inside the boundary becomes a sentence, is counted and logged, and ends nothing."""

import asyncio

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from softtissue_msgs.srv import DecideRegistration, LoadOrgan, Register, Reset, WarpPoints

from softtissue_estimator.errors import OrganError
from softtissue_estimator.ros.boundary import Boundary, is_fatal
from softtissue_estimator.ros.bounded import failed_response


class Log:
    """Keeps the lines of each level."""

    def __init__(self):
        self.lines = {"debug": [], "info": [], "warning": [], "error": []}

    def __getattr__(self, level):
        return self.lines[level].append


@pytest.fixture
def log():
    return Log()


@pytest.fixture
def fatal():
    return []


@pytest.fixture
def boundary(log, fatal):
    return Boundary(log, fatal.append)


def broken(*_arguments):
    raise ZeroDivisionError("secret: what a file contains")


async def broken_later(*_arguments):
    broken()


def test_expected_errors_are_their_own_sentence(boundary, log):
    assert boundary.sentence("load", OrganError("organ: expected a\nfolder")) == "organ: expected a folder"
    assert boundary.faults == 0 and not any(log.lines.values())


def test_unexpected_errors_are_counted_and_traced_once_at_debug_level(boundary, log, fatal):
    guarded = boundary.guarded("surface_points", broken, lambda said, arguments: (said, arguments))
    said, arguments = guarded(1, 2)
    assert arguments == (1, 2)
    assert said == "surface_points: expected no error of the program itself, got ZeroDivisionError"
    for _ in range(5):
        guarded(1, 2)
    assert (boundary.faults, fatal) == (6, [])
    assert log.lines["error"] == [said], "throttled"
    (traced,) = log.lines["debug"]
    assert "Traceback" in traced and "broken" in traced


def test_sentence_tells_nothing_of_what_a_file_contains(boundary):
    assert "secret" not in boundary.guarded("load", broken, lambda said, _: said)()


def test_coroutines_are_guarded_too(boundary):
    guarded = boundary.guarded("load_organ", broken_later, lambda said, _: said)
    assert asyncio.iscoroutinefunction(guarded)
    assert "ZeroDivisionError" in asyncio.run(guarded())


def test_only_a_lack_of_memory_ends_the_process(boundary, fatal):
    def exhausted():
        raise MemoryError

    def absurd():
        np.empty(2**60)

    boundary.guarded("load", exhausted)()
    assert [type(error) for error in fatal] == [MemoryError]
    boundary.guarded("load", absurd)()
    assert len(fatal) == 1, "an array of absurd size takes no memory"
    assert not is_fatal(RecursionError())


def test_executor_goes_on_until_nothing_else_happens(boundary, monkeypatch):
    now = 1000.0
    monkeypatch.setattr("softtissue_estimator.ros.boundary.time.monotonic", lambda: now)
    boundary.alive()
    assert boundary.middleware_goes_on(RuntimeError("take"))
    now += 9.0
    assert boundary.middleware_goes_on(RuntimeError("take"))
    boundary.guarded("timer", lambda: None)()
    now += 9.0
    assert boundary.middleware_goes_on(RuntimeError("take"))
    now += 9.0
    assert not boundary.middleware_goes_on(RuntimeError("take"))
    boundary.alive()
    assert not boundary.middleware_goes_on(MemoryError())


@pytest.mark.parametrize("kind", [DecideRegistration, LoadOrgan, Register, WarpPoints, Reset])
def test_failed_service_never_says_success(kind):
    response = failed_response(kind, kind.Request(), "a sentence")
    assert (response.result, response.message) == (kind.Response.INTERNAL_ERROR, "a sentence")
    assert response.result != kind.Response.SUCCESS


def test_failed_change_of_parameters_refuses_each():
    two = SetParameters.Request(parameters=[Parameter(name="a"), Parameter(name="b")])
    results = failed_response(SetParameters, two, "a sentence").results
    assert [(r.successful, r.reason) for r in results] == 2 * [(False, "a sentence")]
    result = failed_response(SetParametersAtomically, SetParametersAtomically.Request(), "a sentence").result
    assert (result.successful, result.reason) == (False, "a sentence")
