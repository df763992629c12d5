"""The page: what is shown of a view, of what was recorded, or that there is no estimate."""

import math
import threading
from typing import Any

from softtissue_estimator.view.structures import Structures
from softtissue_estimator.viewer import panel_text
from softtissue_estimator.viewer.colours import colours
from softtissue_estimator.viewer.controls import Asked, Choices, Controls
from softtissue_estimator.viewer.export import recording_page
from softtissue_estimator.viewer.moment import Moment
from softtissue_estimator.viewer.recording import Recording, moment_at
from softtissue_estimator.viewer.scene import Look, Scene
from softtissue_estimator.viewer.server import PageServer
from softtissue_estimator.viewer.settings import ViewerSettings
from softtissue_estimator.viewer.state import View
from softtissue_estimator.viewer.watch import SCRIPT

_TEXT_PERIOD_S = 0.25
"""Between two changes of the numbers: nobody reads faster."""
FILE_NAME = "softtissue_recording.html"


class Page:
    """A page and its server.

    Parameters
    ----------
    settings : ViewerSettings
    asked : Asked or None
        None: no buttons that ask the node.

    Raises
    ------
    InvalidInputError
        If the address cannot be served.
    """

    def __init__(self, settings: ViewerSettings, asked: Asked | None) -> None:
        self.settings = settings
        self._server = PageServer(settings.host, settings.port)
        self._server.run_in_pages(SCRIPT)
        self.address = self._server.address
        self._recording = Recording(settings.recording_s, settings.recording_mb * 1_000_000)
        self._past: tuple[Structures, tuple[Moment, ...]] | None = None
        self._said_s = -math.inf
        self._said = ""
        self._exporting = threading.Lock()
        self._lock = threading.Lock()  # the recording is read by those who export it
        self._scene = Scene(self._server)
        self._controls = Controls(self._server, asked, self._on_export)

    def show(self, view: View, now_s: float) -> None:
        """Show a view, or what the time-line points at."""
        if view.structures is not None and view.moment is not None and self.settings.recording_s > 0.0:
            with self._lock:
                self._recording.add(view.structures, view.moment)
        choices = self._controls.choices()
        self._turn_back(choices)
        past_s = None
        structures, moment = view.structures, view.moment
        level, reason = view.level, view.reason
        if self._past is not None and (found := moment_at(self._past[1], choices.seconds)) is not None:
            structures, moment, past_s = self._past[0], found, choices.seconds
            level, reason = found.level, found.reason
        look = None
        if structures is None or moment is None:
            self._scene.hide()
        else:
            look = self._look(structures, moment, choices)
            self._scene.show(structures, moment, look, view.image if past_s is None else None)
        banner = panel_text.banner(level, reason, past_s)
        if banner != self._said or now_s - self._said_s >= _TEXT_PERIOD_S:
            self._said, self._said_s = banner, now_s
            self._say(banner, view, structures, moment, look)

    def answered(self, sentence: str) -> None:
        """Say what a service answered."""
        self._controls.answered(sentence)

    def close(self) -> None:
        """Serve nothing any more."""
        self._server.stop()

    def _turn_back(self, choices: Choices) -> None:
        """Hold the recording while somebody looks back: what comes meanwhile pushes nothing out of it."""
        if choices.live and self._past is not None:
            self._past = None
            self._controls.look_at_now()
        elif not choices.live and self._past is None:
            moments, structures = self._recording.moments, self._recording.structures
            if structures is not None and moments:
                self._past = structures, moments
                self._controls.look_back(moments[-1].time_s - moments[0].time_s)

    def _look(self, structures: Structures, moment: Moment, choices: Choices) -> Look:
        return Look(
            tuple(
                colours(
                    structures,
                    moment.sigma if choices.by_sigma else None,
                    1e-3 * self.settings.sigma_scale_mm,
                )
            ),
            choices.opacity,
            choices.observed,
            choices.frames,
            choices.clip,
        )

    def _say(
        self,
        banner: str,
        view: View,
        structures: Structures | None,
        moment: Moment | None,
        look: Look | None,
    ) -> None:
        legend = ""
        if structures is not None and moment is not None and look is not None:
            sigma_mm = [1e3 * float(sigma) for sigma in moment.sigma]
            by_sigma = self._controls.choices().by_sigma
            scale = self.settings.sigma_scale_mm if by_sigma else None
            legend = panel_text.legend(structures, list(look.colours), sigma_mm, scale)
        self._controls.say(
            banner=banner,
            numbers=panel_text.numbers(view.health),
            legend=legend,
            distances=panel_text.distances(view.distances),
        )

    def _on_export(self, client: Any) -> None:
        """Make the file and send it to who pressed the button; one at a time."""
        with self._lock:
            structures, moments = self._recording.structures, self._recording.moments
        if client is None:
            return
        if structures is None or not moments:
            client.add_notification("export", "expected a recording, got none yet", auto_close_seconds=8.0)
            return
        if not self._exporting.acquire(blocking=False):
            client.add_notification("export", "a file is being made already", auto_close_seconds=8.0)
            return
        try:
            note = client.add_notification("export", f"making a file of {len(moments)} moments", loading=True)
            scale_m = 1e-3 * self.settings.sigma_scale_mm
            page = recording_page(structures, moments, scale_m if self._controls.choices().by_sigma else None)
            note.remove()
            client.send_file_download(FILE_NAME, page.encode("utf-8"))
        finally:
            self._exporting.release()
