"""The viewer as a process of its own in a real browser, with an estimator's node that this test plays."""

import shutil
import signal
import threading
import time
from contextlib import contextmanager

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")
pytest.importorskip("viser", reason="the packages of requirements-viewer.txt are not installed")
pytest.importorskip("playwright", reason="Playwright is not installed")

from geometry_msgs.msg import PoseWithCovarianceStamped
from playwright.sync_api import sync_playwright
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import Distances, EstimatorStatus, Structures

from integration.harness import AtRate, NodeProcess, PlainClient, executable
from integration.played_node import ESTIMATOR, PlayedNode
from ros_domain import reserved

CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not there (Debian's package chromium)")
# Software draws here: what changes is asserted, not how often.
SOFTWARE = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
SHIFT = 0.025
ANSWER_HZ = 10.0


class Theatre(PlainClient):
    """The played node, spun by a thread, and the page in a browser."""

    def __init__(self, domain):
        super().__init__(domain, "softtissue_viewer")
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._spin)
        self.played = PlayedNode(self)
        self._thread.start()

    def __exit__(self, *exception):
        self._ended.set()
        self._thread.join()
        super().__exit__(*exception)

    def _spin(self):
        while not self._ended.is_set():
            self.executor.spin_once(timeout_sec=0.05)

    def restart(self):
        """End the played node and begin another one, as after a crash."""
        self._ended.set()
        self._thread.join()
        self.played.close()
        self.played = PlayedNode(self)
        self._ended.clear()
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    @contextmanager
    def answering(self, change=lambda played: None):
        """Answer at a steady rate as long as the block lasts."""

        def answer():
            change(self.played)
            self.played.answer()

        with AtRate(answer, ANSWER_HZ):
            yield

    def until(self, condition, what, timeout=20.0):
        end = time.monotonic() + timeout
        while not (value := condition()):
            assert time.monotonic() < end, f"no {what} within {timeout} s; page: {self.said_on_page()!r}"
            self.page.wait_for_timeout(100)
        return value

    def said_on_page(self):
        return self.page.locator(".softtissue-banner").inner_text()

    def until_said(self, words):
        self.until(lambda: words in self.said_on_page(), words)

    def picture(self):
        """What the page shows, without its panel: (height, width, 3), red, green and blue."""
        return pixels(self.page.locator("canvas").first.screenshot(type="png"))

    def until_drawn(self):
        return self.until(lambda: green(self.picture()), "tumour on the page")


def pixels(png):
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def green(picture):
    """Mean column of the pixels that have the tumour's colour, in widths of the picture; None where there are few."""
    mask = (picture[..., 1] > picture[..., 0] + 40) & (picture[..., 1] > picture[..., 2] + 40)
    columns = np.nonzero(mask)[1]
    return None if len(columns) < 200 else columns.mean() / picture.shape[1]


@pytest.fixture(scope="module")
def browser():
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def theatre(tmp_path_factory, browser):
    parameters = {"port": 0, "maximum_age_s": 1.0, "recording_s": 20.0}
    folder, program = tmp_path_factory.mktemp("viewer"), [executable("viewer")]
    with (
        reserved() as domain,
        NodeProcess(domain, folder, parameters, program) as viewer,
        Theatre(domain) as theatre,
    ):
        viewer.wait_for_text("serving http://127.0.0.1:", 60.0)
        theatre.log = viewer
        theatre.address = viewer.text.partition("serving ")[2].split()[0]
        theatre.page = browser.new_page(viewport={"width": 1000, "height": 640}, accept_downloads=True)
        theatre.requests = []
        theatre.page.on("request", lambda request: theatre.requests.append(request.url))
        theatre.page.goto(theatre.address)
        # Any of the tests may be the first of its process.
        theatre.until(theatre.played.heard, "viewer's subscriptions")
        theatre.played.describe()
        # They have nearly the colour of the tumour.
        theatre.page.get_by_label("observed points").uncheck(timeout=20_000, force=True)
        yield theatre
        theatre.page.close()
        assert viewer.stop(signal.SIGINT) == 0
        assert "Traceback" not in viewer.text


def test_page_says_that_there_is_no_estimate_before_the_first_answer(theatre):
    theatre.until_said("NO ESTIMATE")
    assert green(theatre.picture()) is None


def test_page_shows_the_tumour_and_what_the_status_says_and_asks_no_other_host(theatre):
    with theatre.answering():
        theatre.until_drawn()
        theatre.until_said("OK")
        panel = theatre.page.locator("body").inner_text()
        for words in ("42 ms", "25 %", "23.1 ± 1.5 mm", "growth"):
            assert words in panel, panel
        shown = theatre.picture()
    assert shown.std() > 10.0
    assert {url.partition("?")[0].rstrip("/") for url in theatre.requests if url.startswith("http")} == {
        theatre.address
    }


def test_picture_changes_from_frame_to_frame(theatre):
    def move(played):
        played.shift = SHIFT * np.sin(played.number / 15.0)

    with theatre.answering(move):
        theatre.until_drawn()
        places = []

        def moved():
            place = green(theatre.picture())
            places.extend([] if place is None else [place])
            return len(set(places)) >= 4 and max(places) - min(places) > 0.05

        theatre.until(moved, "tumour that moves")


def test_structures_have_the_colour_of_their_deviation_if_asked(theatre):
    switch = theatre.page.get_by_label("colour by sigma")
    with theatre.answering():
        theatre.until_drawn()
        switch.check(force=True)
        theatre.until(lambda: green(theatre.picture()) is None, "other colour")
        switch.uncheck(force=True)
        theatre.until_drawn()


def test_buttons_ask_the_node_and_its_answers_are_shown(theatre):
    page, body = theatre.page, theatre.page.locator("body")
    theatre.until(lambda: theatre.node.count_clients(f"{ESTIMATOR}/reset"), "viewer's clients")
    page.get_by_role("button", name="register").click()
    theatre.until(lambda: "register: expected a cloud, got none" in body.inner_text(), "answer of register")
    page.get_by_role("button", name="reset").click()
    theatre.until(lambda: "reset: done" in body.inner_text(), "answer of reset")
    folder = page.locator("xpath=//*[normalize-space(text())='folder']/following::input[1]")
    folder.fill("/data/liver")
    folder.press("Enter")
    page.wait_for_timeout(500)
    page.get_by_role("button", name="load organ").click()
    theatre.until(
        lambda: "load_organ: loaded <b>/data/liver</b>" in body.inner_text(), "answer of load_organ"
    )
    assert theatre.played.asked == [("register", True), ("reset",), ("load_organ", "/data/liver")]


def test_no_estimate_is_said_and_nothing_drawn_after_answers_stop(theatre):
    with theatre.answering():
        theatre.until_drawn()
    theatre.until_said("NO ESTIMATE")
    theatre.until(lambda: green(theatre.picture()) is None, "empty page")
    assert "expected an answer every 1 s (maximum_age_s)" in theatre.said_on_page()


def test_nothing_is_drawn_while_the_status_is_invalid(theatre):
    with theatre.answering():
        theatre.until_drawn()
    theatre.played.statuses.publish(
        EstimatorStatus(level=EstimatorStatus.INVALID, reason="the organ is <i>lost")
    )
    theatre.until_said("INVALID\nthe organ is <i>lost")
    theatre.until(lambda: green(theatre.picture()) is None, "empty page")


def test_messages_that_cannot_be_used_get_a_sentence_each_and_end_nothing(theatre):
    played, pose = theatre.played, PoseWithCovarianceStamped()
    pose.pose.pose.orientation.w = float("nan")
    for message, publisher, words in (
        (
            PointCloud2(width=5, height=1, point_step=12, data=bytes(60)),
            played.points,
            "expected fields x y z",
        ),
        (pose, played.poses, "expected finite numbers"),
        (EstimatorStatus(level=9), played.statuses, "status: expected a level of 0 to 2, got 9"),
        (Distances(names=["a"]), played.distances, "tool_distances: expected 1 kinds"),
        (Structures(names=["a"]), played.structures, "structures: expected 1 kinds and colours"),
    ):
        publisher.publish(message)
        theatre.log.wait_for_text(words)
    played.describe()
    with theatre.answering():
        theatre.until_drawn()


def test_time_line_shows_what_was_and_the_recording_opens_without_the_viewer(theatre, browser, tmp_path):
    def move(played):
        played.shift = SHIFT if played.number % 40 < 20 else -SHIFT

    with theatre.answering(move):
        theatre.until_drawn()
        theatre.page.wait_for_timeout(3000)
    theatre.until_said("NO ESTIMATE")
    theatre.page.get_by_label("live").uncheck(force=True)
    theatre.until_said("RECORDED")
    theatre.until_drawn()
    with theatre.page.expect_download(timeout=30_000) as download:
        theatre.page.get_by_role("button", name="export").click()
        theatre.page.get_by_text("softtissue_recording.html").click(timeout=20_000)
    path = tmp_path / "recording.html"
    download.value.save_as(path)
    theatre.page.get_by_label("live").check(force=True)
    theatre.until_said("NO ESTIMATE")
    alone = browser.new_context(offline=True, viewport={"width": 800, "height": 600}).new_page()
    alone.goto(path.as_uri())
    end = time.monotonic() + 20.0
    while green(pixels(alone.screenshot())) is None:
        assert time.monotonic() < end, "nothing is drawn by the exported file"
        alone.wait_for_timeout(200)
    alone.context.close()


def test_page_goes_on_with_a_node_that_was_started_again(theatre):
    with theatre.answering():
        theatre.until_drawn()
    theatre.restart()
    theatre.until_said("NO ESTIMATE")
    theatre.played.describe()
    with theatre.answering():
        theatre.until_drawn()
        theatre.until_said("OK")


def test_page_is_covered_while_the_viewer_hangs(theatre):
    cover = theatre.page.locator("#softtissue-silent")
    with theatre.answering():
        theatre.until_drawn()
        assert not cover.is_visible()
        theatre.log.send(signal.SIGSTOP)
        try:
            theatre.until(cover.is_visible, "cover")
            assert green(pixels(theatre.page.screenshot())) is None
        finally:
            theatre.log.send(signal.SIGCONT)
        theatre.until(lambda: not cover.is_visible(), "page without cover")
        theatre.until_drawn()


def test_closed_panel_is_said_and_covers_nothing(theatre):
    strip, cover = (theatre.page.locator(f"#softtissue-{name}") for name in ("closed", "silent"))
    assert not strip.is_visible()
    with theatre.answering():
        # viser's way to close a panel is a sign in its corner that has no name.
        theatre.page.mouse.click(1000 - 13, 8)
        theatre.until(strip.is_visible, "strip")
        theatre.page.wait_for_timeout(4000)
        assert not cover.is_visible() and green(theatre.picture())
    theatre.page.reload()
    theatre.until_said("NO ESTIMATE")
    assert not strip.is_visible()


def test_taken_port_is_one_sentence_and_exit_code_2(theatre, tmp_path, domain):
    port = theatre.address.rpartition(":")[2]
    with NodeProcess(domain, tmp_path, {"port": port}, [executable("viewer")]) as second:
        assert second.wait() == 2
        (line,) = (line for line in second.text.splitlines() if "[INFO]" not in line)
    assert line.startswith(f"error: port: expected one that is free at 127.0.0.1, got {port}")
