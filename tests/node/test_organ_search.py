"""`registration_source: auto`: when the node searches, what it takes, and what somebody decides about it."""

import dataclasses
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from scipy.spatial.transform import Rotation
from softtissue_msgs.srv import DecideRegistration

from estimator.lump import make_lump
from integration.scene import cloud_message, registration_message, stamp_message
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.organ import make_organ
from softtissue_estimator.registration.find_pose import FoundPose
from softtissue_estimator.ros import organ_search
from softtissue_estimator.ros.frames import Frame
from softtissue_estimator.ros.inputs.kinds import Kind
from softtissue_estimator.ros.inputs.registration import OrganPose, Registration
from softtissue_estimator.ros.organ_search import OrganSearch

STAMP, FRAME, ROOM = 1_700_000_000_000_000_000, "laparoscope", "room"
SURFACE = make_lump()
ORGAN = make_organ("lump", "organ", SURFACE, (), np.zeros(len(SURFACE.vertices), dtype=bool))
MOTION = RigidMotion(
    Rotation.from_euler("xyz", [20.0, -130.0, 70.0], degrees=True).as_matrix(), np.array([0.01, 0.02, 0.15])
)
CAMERA = np.eye(4)
CAMERA[:3, :3] = Rotation.from_euler("xyz", [5.0, 40.0, -20.0], degrees=True).as_matrix()
CAMERA[:3, 3] = [0.3, -0.1, 0.2]
FOUND = FoundPose(MOTION, 1e-4 * np.eye(6), 0.001, 0.6, False, None, np.inf, "one pose explains the cloud")
UNSURE = dataclasses.replace(FOUND, ambiguous=True, message="a second pose explains the cloud almost as well")
REQUEST, CODES = DecideRegistration.Request, DecideRegistration.Response
POINTS = np.arange(30.0).reshape(10, 3) * 1e-3
CLOUD = Frame(cloud_message(POINTS, ("x", "y", "z"), STAMP, FRAME), None, 0.0, 0, Kind.BARE)
ELASTIC = np.ones((5, 2), dtype=np.float32)
GIVEN = OrganPose(ROOM, "organ", np.eye(4), told=True)


class Node:
    """What the search needs of a node; its process answers at once."""

    def __init__(self, found=FOUND, source="auto"):
        self.found, self.questions, self.go_on = found, [], threading.Event()
        self.go_on.set()
        self.registration = Registration()
        config = EstimatorConfig(registration_source=source)
        self.search = OrganSearch(
            self.registration,
            lambda: config,
            lambda _where, error: str(error),
            lambda _said: None,
            SimpleNamespace(find=self._find, prepare=lambda *what: self.prepared.append(what)),
            lambda organ: ELASTIC if organ is ORGAN else None,
        )
        self.prepared = []
        self.search.begin(ORGAN)

    def _find(self, question):
        self.questions.append(question)
        assert self.go_on.wait(10.0)
        return self.found

    def away(self, reason="a reason"):
        return self.search.away(CLOUD, ORGAN, reason)

    def searched(self, number=1):
        """Wait until so many searches are done."""
        end = time.monotonic() + 10.0
        while len(self.questions) < number or self.search.state == "searching":
            assert time.monotonic() < end, "no search came to an end"
            time.sleep(0.005)

    def decide(self, decision):
        return self.search.decide(decision, CODES())


def in_room(node):
    pose = registration_message(CAMERA, ROOM, FRAME)
    pose.header.stamp = stamp_message(STAMP)
    node.registration.cameras.put(pose)


def found_motion():
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = MOTION.rotation, MOTION.translation
    return motion


def test_without_auto_nothing_is_searched_for():
    node = Node(source="given")
    assert node.away() == "a reason"
    assert (node.questions, node.search.state) == ([], "none")


def test_what_is_found_is_registered_in_the_fixed_frame():
    node = Node()
    in_room(node)
    node.go_on.clear()
    said = node.away()
    assert said.startswith("searching for the organ in the cloud") and node.search.state == "searching"
    node.go_on.set()
    node.searched()
    pose = node.registration.newest
    assert (pose.cloud_frame, pose.organ_frame, node.search.state) == (ROOM, "organ", "found")
    np.testing.assert_allclose(pose.motion, CAMERA @ found_motion(), atol=1e-12)
    # Translations of the centre and turns about it are alike in every direction here.
    np.testing.assert_allclose(pose.covariance_at(ORGAN.centre), FOUND.covariance, atol=1e-12)
    np.testing.assert_array_equal(node.questions[0].camera, np.zeros(3))


def test_the_search_is_told_how_the_organ_bends():
    node = Node()
    node.search.prepare(ORGAN)
    node.away()
    node.searched()
    assert node.questions[0].elastic is ELASTIC
    assert [(surface, elastic) for surface, elastic in node.prepared] in (
        [],  # the cloud came first
        [(ORGAN.surface, ELASTIC)],
    )


def test_an_organ_that_comes_back_at_once_is_not_searched_for(monkeypatch):
    node = Node()
    node.registration.take(GIVEN)
    assert node.away() == "a reason"
    node.search.answered()
    monkeypatch.setattr(organ_search, "PATIENCE_S", 0.05)
    assert node.away() == "a reason"
    time.sleep(0.06)
    assert "a reason" in node.away() and node.search.state in ("searching", "found")
    node.searched()
    assert node.registration.newest is not GIVEN


def test_what_is_found_after_the_organ_came_back_is_not_used():
    node = Node()
    node.go_on.clear()
    node.away()
    node.search.answered()
    node.go_on.set()
    time.sleep(0.05)
    assert node.registration.newest is None


def test_an_ambiguous_pose_waits_until_it_is_accepted():
    node = Node(UNSURE)
    node.away()
    node.searched()
    assert node.registration.newest is None
    assert "second pose explains" in node.away() and "~/decide_registration" in node.away()
    node.searched(2)
    assert node.decide(REQUEST.ACCEPT).result == CODES.SUCCESS
    assert node.search.state == "accepted"
    np.testing.assert_allclose(node.registration.newest.motion, found_motion(), atol=1e-12)


def test_an_accepted_registration_is_kept_after_the_organ_was_lost(monkeypatch):
    monkeypatch.setattr(organ_search, "PATIENCE_S", 0.0)
    node = Node()
    node.away()
    node.searched()
    assert node.decide(REQUEST.ACCEPT).message == "the registration is accepted"
    assert "a reason; the registration is accepted" in node.away()
    assert len(node.questions) == 1
    node.registration.take(GIVEN)  # somebody's new one is not accepted yet
    assert node.search.state == "given"


def test_a_rejected_pose_is_searched_around():
    node = Node()
    in_room(node)
    node.away()
    node.searched()
    assert node.decide(REQUEST.REJECT).result == CODES.SUCCESS
    assert node.registration.newest is None
    assert "rejected" in node.away()
    node.searched(2)
    (wrong,) = node.questions[1].rejected
    np.testing.assert_allclose(wrong.rotation, MOTION.rotation, atol=1e-12)
    np.testing.assert_allclose(wrong.translation, MOTION.translation, atol=1e-12)


def test_nothing_replaces_a_frozen_registration(monkeypatch):
    monkeypatch.setattr(organ_search, "PATIENCE_S", 0.0)
    node = Node()
    node.away()
    node.searched()
    assert node.decide(REQUEST.FREEZE).result == CODES.SUCCESS
    before = node.registration.newest
    assert "frozen" in node.away() and len(node.questions) == 1
    with pytest.raises(InvalidInputError, match="frozen"):
        node.registration.take(GIVEN)
    assert node.registration.newest is before and node.search.state == "frozen"
    assert node.decide(REQUEST.ACCEPT).result == CODES.SUCCESS
    node.registration.take(GIVEN)


@pytest.mark.parametrize("decision", [0, 4, 255])
def test_what_cannot_be_decided_is_refused_in_a_sentence(decision):
    node = Node()
    assert "expected a registration" in node.decide(REQUEST.ACCEPT).message
    node.registration.take(GIVEN)
    assert "one that was given" in node.decide(REQUEST.REJECT).message
    response = node.decide(decision)
    assert response.result == CODES.INVALID and f"got {decision}" in response.message


def test_what_was_found_of_another_organ_is_forgotten():
    node = Node()
    node.away()
    node.searched()
    node.decide(REQUEST.FREEZE)
    other = make_organ("other", "organ", make_lump(), (), np.zeros(len(SURFACE.vertices), dtype=bool))
    node.search.begin(dataclasses.replace(other, name="again"))
    assert node.search.state == "frozen"  # the same surface
    moved = dataclasses.replace(SURFACE, vertices=SURFACE.vertices + 0.01)
    node.search.begin(dataclasses.replace(other, surface=moved))
    assert (node.registration.newest, node.search.state) == (None, "none")
