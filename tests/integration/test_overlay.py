"""The overlay as a process of its own, between a camera and an estimator's node that this test plays."""

import signal

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from softtissue_msgs.msg import EstimatorStatus, Structures
from std_msgs.msg import ColorRGBA

from estimator.overlay.ball import balls
from integration.harness import NodeProcess, PlainClient, executable
from integration.scene import nanoseconds
from ros_domain import reserved
from softtissue_estimator.ros.inputs.conversions import make_cloud, time_message

NAME, ESTIMATOR = "softtissue_overlay", "softtissue_estimator"
MATRIX = [560.0, 0.0, 319.5, 0.0, 560.0, 239.5, 0.0, 0.0, 1.0]
DISTORTION = [-0.2, 0.05, 0.0005, 0.0, 0.0]
S, GREY = 1_000_000_000, 100
CENTRE = np.array([0.02, -0.01, 0.0])  # of a tumour, organ's frame, m
DEPTH_M = 0.12  # of the organ's frame in front of the camera
RECORD = np.dtype([(name, "<f4") for name in ("x", "y", "z", "sigma")])


class Theatre(PlainClient):
    """Camera and estimator, and a screen on which images arrive."""

    def __init__(self, domain):
        super().__init__(domain, NAME)
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        publish, node = self.node.create_publisher, self.node
        self.images = publish(Image, "image", 10)
        self.cameras = publish(CameraInfo, "camera_info", 10)
        self.masks = publish(Image, "instrument_mask", 10)
        self.answers = publish(PointCloud2, f"{ESTIMATOR}/deformed_points", 10)
        self.poses = publish(PoseWithCovarianceStamped, f"{ESTIMATOR}/registration", 10)
        self.statuses = publish(EstimatorStatus, f"{ESTIMATOR}/status", kept)
        self.structures = publish(Structures, f"{ESTIMATOR}/structures", kept)
        self.publishers = [
            self.images,
            self.cameras,
            self.masks,
            self.answers,
            self.poses,
            self.statuses,
            self.structures,
        ]
        self.shown, self.files = [], []
        node.create_subscription(Image, f"{NAME}/image", self.shown.append, 10)
        node.create_subscription(CompressedImage, f"{NAME}/image/compressed", self.files.append, 10)
        self.stamp = 100 * S

    def describe(self):
        structures, placed = balls([CENTRE], [0.006], kinds=["tumour"])
        message = Structures(names=list(structures.names), kinds=["tumour"], colours=[ColorRGBA(g=1.0)])
        message.header.frame_id = "organ"
        message.first_vertex, message.first_face = [0, len(placed.points)], [0, len(structures.faces[0])]
        message.faces = structures.faces[0].ravel().tolist()
        self.structures.publish(message)
        self.points = placed.points
        info = CameraInfo(height=480, width=640, distortion_model="plumb_bob", d=DISTORTION, k=MATRIX)
        self.cameras.publish(info)

    def answer(self, level=EstimatorStatus.OK, reason="", points=None):
        """Send an answer of the present stamp with its pose and its status."""
        points = self.points if points is None else points
        table = np.zeros(len(points), dtype=RECORD)
        for axis, name in enumerate("xyz"):
            table[name] = points[:, axis]
        pose = PoseWithCovarianceStamped()
        pose.header.frame_id, pose.header.stamp = "eye", time_message(self.stamp)
        pose.pose.pose.orientation.w, pose.pose.pose.position.z = 1.0, DEPTH_M
        self.poses.publish(pose)
        self.answers.publish(make_cloud(table, "organ", self.stamp))
        self.statuses.publish(EstimatorStatus(level=level, reason=reason))
        self.spin(0.2)

    def said(self):
        return f"the overlay said: {self.log.text[-1500:]}"

    def image(self, **changes):
        message = Image(height=480, width=640, encoding="rgb8", step=1920)
        message.header.frame_id, message.header.stamp = "eye", time_message(self.stamp)
        message.data = np.full(480 * 640 * 3, GREY, np.uint8).tobytes()
        for name, value in changes.items():
            setattr(message, name, value)
        return message

    def see(self, **changes):
        """Send an image of the present stamp; return its drawn pixels (480, 640, 3), red, green and blue."""
        self.see_any(self.image(**changes))
        found = self.shown[0]
        assert nanoseconds(found.header.stamp) == self.stamp
        assert (found.header.frame_id, found.encoding) == ("eye", "rgb8")
        return np.frombuffer(found.data, np.uint8).reshape(480, 640, 3)

    def see_any(self, message):
        """Send an image until one is shown, as a camera does: some are lost where both cores are busy."""
        self.shown.clear()

        def shown():
            self.images.publish(message)
            self.spin(0.3)
            return self.shown

        self.wait(shown, "image")


@pytest.fixture(scope="module")
def theatre(tmp_path_factory):
    parameters = {"margin_mm": 0.0, "names": False, "maximum_age_s": 0.5}
    program = [executable("overlay")]
    with (
        reserved() as domain,
        NodeProcess(domain, tmp_path_factory.mktemp("overlay"), parameters, program) as node,
        Theatre(domain) as theatre,
    ):
        node.wait_for_text("drawing on images of /image", 100.0)
        theatre.log = node
        out = theatre.node.count_publishers
        theatre.wait(lambda: all(one.get_subscription_count() for one in theatre.publishers), "overlay")
        theatre.wait(lambda: out(f"{NAME}/image") and out(f"{NAME}/image/compressed"), "its images")
        theatre.spin(0.5)  # the overlay's side of the match
        theatre.describe()
        theatre.spin(0.5)
        yield theatre
        assert node.stop(signal.SIGINT) == 0
        assert "Traceback" not in node.text


@pytest.fixture(autouse=True)
def later(theatre):
    """Each test is 10 s after the one before: what that one saw is too old."""
    theatre.stamp += 10 * S
    theatre.statuses.publish(EstimatorStatus())
    theatre.spin(0.1)


def drawn(image):
    """Mask of the structure's colour, below the banner's place."""
    return (image[..., 1].astype(int) > image[..., 0].astype(int) + 15) & (np.arange(480) > 120)[:, None]


def banner(image):
    return bool((image[:20] != GREY).any())


def test_structure_is_where_opencv_projects_it(theatre):
    theatre.answer()
    image = theatre.see()
    rows, columns = np.nonzero(drawn(image))
    middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2.0
    centre = CENTRE + np.array([0.0, 0.0, DEPTH_M])
    wanted, _ = cv2.projectPoints(
        centre[None], np.zeros(3), np.zeros(3), np.reshape(MATRIX, (3, 3)), np.array(DISTORTION)
    )
    np.testing.assert_allclose(middle, wanted[0, 0], atol=1.0)  # of the outline of a ball, seen from the side
    assert not banner(image)


def test_compressed_image_shows_the_same(theatre):
    theatre.answer()
    theatre.files.clear()
    image = theatre.see()
    theatre.wait(lambda: theatre.files, "compressed image")
    assert nanoseconds(theatre.files[0].header.stamp) == theatre.stamp
    decoded = cv2.imdecode(np.frombuffer(theatre.files[0].data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(decoded.astype(int) - image).mean() < 2.0


def test_nothing_is_drawn_from_an_old_answer(theatre):
    theatre.answer()
    assert drawn(theatre.see()).any()
    theatre.stamp += int(0.51 * S)
    image = theatre.see()
    assert not drawn(image).any() and banner(image)
    assert "no estimate: expected an answer within 0.5 s of the image" in theatre.log.text


def test_degraded_is_said_and_drawn_invalid_is_said_and_not_drawn(theatre):
    theatre.answer(EstimatorStatus.DEGRADED, "little is seen")
    image = theatre.see()
    assert drawn(image).any() and banner(image)
    theatre.statuses.publish(EstimatorStatus(level=EstimatorStatus.INVALID, reason="lost"))
    theatre.spin(0.2)
    image = theatre.see()
    assert not drawn(image).any() and banner(image)


def test_answer_that_is_not_finite_draws_nothing_and_ends_nothing(theatre):
    theatre.answer(points=np.full_like(theatre.points, np.nan))
    assert not drawn(theatre.see()).any()
    theatre.answer()
    assert drawn(theatre.see()).any()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"encoding": "32FC1"}, "image: expected an encoding of bgr8"),
        ({"data": b"abc"}, "and 3 bytes"),
    ],
)
def test_image_that_cannot_be_used_gets_a_sentence_and_the_next_is_drawn(theatre, changes, words):
    def said():
        theatre.images.publish(theatre.image(**changes))
        theatre.spin(0.3)
        return words in theatre.log.text

    theatre.wait(said, words)
    theatre.answer()
    assert drawn(theatre.see()).any()


def test_nothing_is_drawn_on_instruments_while_somebody_says_where_they_are(theatre):
    theatre.answer()
    before = drawn(theatre.see())
    columns = np.flatnonzero(before.any(axis=0))
    middle = (columns[0] + columns[-1]) // 2
    marked = np.zeros((480, 640), np.uint8)
    marked[:, middle:] = 1
    message = theatre.image(encoding="mono8", step=640, data=marked.tobytes())

    def spared():
        theatre.masks.publish(message)  # as best effort, one may be lost
        theatre.spin(0.3)
        image = theatre.see()
        return [image] if (image[:, middle:] == GREY).all() else []

    (image,) = theatre.wait(spared, "mask")
    np.testing.assert_array_equal(drawn(image)[:, :middle], before[:, :middle])
    theatre.stamp += int(0.4 * S)
    assert drawn(theatre.see())[:, middle:].any()
    theatre.log.wait_for_text(
        "mask: expected one within 0.2 s of the image (maximum_mask_age_s), got one 0.40 s"
    )


def test_image_of_another_size_than_the_cameras_is_passed_on_with_a_sentence(theatre):
    theatre.answer()
    theatre.see_any(theatre.image(height=240, data=bytes(240 * 1920)))
    assert theatre.shown[0].height == 240
    theatre.log.wait_for_text("expected 640 x 480 pixels as camera_info says, got 640 x 240")


def test_messages_that_cannot_be_used_get_a_sentence_each_and_end_nothing(theatre):
    wrong = Structures(names=["tumour"], kinds=["tumour"], colours=[ColorRGBA()])
    wrong.first_vertex, wrong.first_face, wrong.faces = [0, 3], [0, 1], [0, 1, 3_000_000]
    theatre.structures.publish(wrong)
    theatre.log.wait_for_text("structures: expected triangles of 'tumour' between its own vertices")
    theatre.answers.publish(PointCloud2(width=5, height=1, point_step=12, data=bytes(60)))
    theatre.log.wait_for_text("cloud: expected fields x y z")
    pose = PoseWithCovarianceStamped()
    pose.pose.pose.orientation.w = float("nan")
    theatre.poses.publish(pose)
    theatre.log.wait_for_text("expected finite numbers")
    theatre.cameras.publish(CameraInfo(height=480, width=640))
    theatre.answer(points=theatre.points[:7])
    assert not drawn(theatre.see()).any()
    theatre.log.wait_for_text(f"expected {len(theatre.points)} rows in an answer, got 7")
    theatre.stamp += 10 * S
    theatre.answer()
    assert not drawn(theatre.see()).any()
    theatre.log.wait_for_text("expected positive focal lengths (a calibrated camera)")
    theatre.describe()
    theatre.spin(0.3)
    theatre.answer()
    assert drawn(theatre.see()).any()


def test_newest_image_is_drawn_and_none_is_queued(theatre):
    """Of a burst of images the last is drawn; each once at most, in order."""
    theatre.answer()
    theatre.shown.clear()
    stamps = []
    for number in range(40):
        message = theatre.image()
        message.header.stamp = time_message(theatre.stamp + number)
        stamps.append(theatre.stamp + number)
        theatre.images.publish(message)

    def last_shown():
        theatre.spin(0.3)
        seen = [nanoseconds(image.header.stamp) for image in theatre.shown]
        if stamps[-1] in seen:
            return seen[: seen.index(stamps[-1]) + 1]
        theatre.images.publish(message)  # as best effort, it may have been lost
        return None

    seen = theatre.wait(last_shown, "last image")
    assert seen == sorted(set(seen)) and len(seen) < 40


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--ros-args", "-p", "margin_mm:=-1.0"], "parameter margin_mm"),
        (["--ros-args", "-p", "image_transport:=theora"], "expected one of raw, compressed"),
    ],
)
def test_wrong_arguments_are_one_sentence_and_exit_code_2(tmp_path, domain, arguments, words):
    with NodeProcess(domain, tmp_path, {}, [executable("overlay"), *arguments]) as node:
        assert node.wait() == 2
        assert words in node.text and "Traceback" not in node.text
