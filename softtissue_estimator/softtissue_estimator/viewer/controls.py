"""The page's panel: texts, switches, sliders and buttons, which are the same for all who look."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from softtissue_estimator.viewer import panel_text
from softtissue_estimator.viewer.clipping import WHOLE, Clip
from softtissue_estimator.viewer.watch import beat


class Asked(Protocol):
    """Who asks the node when a button is pressed; called in threads of the server."""

    def register(self) -> None:
        """Find the organ's pose."""

    def reset(self) -> None:
        """Forget the present estimate."""

    def load_organ(self, folder: str) -> None:
        """Change the organ."""


@dataclass(frozen=True)
class Choices:
    """How the switches and sliders stand.

    Attributes
    ----------
    by_sigma : bool
        Colour the structures by their standard deviations.
    opacity : float
        Of the organ, 0 to 1.
    observed, frames : bool
    clip : Clip
    live : bool
        Show what is now, and not what was recorded.
    seconds : float
        Place on the time-line, after the recording's begin.
    """

    by_sigma: bool
    opacity: float
    observed: bool
    frames: bool
    clip: Clip
    live: bool
    seconds: float


class Controls:
    """The panel of a page.

    Parameters
    ----------
    server : viser.ViserServer
    asked : Asked or None
        None: no buttons that ask the node.
    on_export : callable
        Takes who wants a file (viser's client handle); called in a thread of the server.
    """

    def __init__(self, server: Any, asked: Asked | None, on_export: Callable[[Any], None]) -> None:
        gui = server.gui
        gui.set_panel_label("Soft-tissue navigation")
        gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=(90, 140, 210)
        )
        gui.main_panel.dock_right()
        self._beat, self._beats = gui.add_html(beat(0)), 0
        self._banner = gui.add_html("")
        self._numbers = gui.add_html("")
        self._legend = gui.add_html("")
        self._distances = gui.add_html("")
        with gui.add_folder("View"):
            self._by_sigma = gui.add_checkbox("colour by sigma", False, hint="largest one of each structure")
            self._opacity = gui.add_slider("organ's opacity", 0.0, 1.0, 0.05, 0.3)
            self._observed = gui.add_checkbox("observed points", True)
            self._frames = gui.add_checkbox("frames", True, hint="of the organ and of the clouds")
        with gui.add_folder("Clip", expand_by_default=False):
            self._axes = [
                gui.add_multi_slider(axis, 0.0, 100.0, 1.0, WHOLE) for axis in ("x %", "y %", "z %")
            ]
            self._structures_too = gui.add_checkbox("structures too", False)
        with gui.add_folder("Recording"):
            self._live = gui.add_checkbox("live", True, hint="take away the tick to look back")
            self._seconds = gui.add_slider("time (s)", 0.0, 1.0, 0.1, 0.0, disabled=True)
            self._export = gui.add_button("export", hint="a file that any browser opens, with this recording")
        self._export.on_click(lambda event: on_export(event.client))
        self._answered: Any = None
        if asked is not None:
            with gui.add_folder("Node"):
                self._add_buttons(gui, asked)

    def _add_buttons(self, gui: Any, asked: Asked) -> None:
        register = gui.add_button("register", hint="find the organ in the newest cloud and take its pose")
        reset = gui.add_button("reset", hint="forget the present estimate")
        folder = gui.add_text("folder", "", hint="of an organ, on the node's machine; empty: the bundled one")
        load = gui.add_button("load organ")
        self._answered = gui.add_html("")
        register.on_click(lambda _: asked.register())
        reset.on_click(lambda _: asked.reset())
        load.on_click(lambda _: asked.load_organ(str(folder.value)))

    def choices(self) -> Choices:
        """Return how everything stands."""
        x, y, z = (_share(axis.value) for axis in self._axes)
        return Choices(
            by_sigma=self._by_sigma.value,
            opacity=float(self._opacity.value),
            observed=self._observed.value,
            frames=self._frames.value,
            clip=Clip(x, y, z, self._structures_too.value),
            live=self._live.value,
            seconds=float(self._seconds.value),
        )

    def say(self, *, banner: str, numbers: str, legend: str, distances: str) -> None:
        """Say what is new, and that the viewer lives; each is HTML of `panel_text`."""
        self._beats += 1
        self._beat.content = beat(self._beats)
        self._banner.content, self._numbers.content = banner, numbers
        self._legend.content, self._distances.content = legend, distances

    def look_back(self, length_s: float) -> None:
        """Let the time-line reach over a recording, and stand at its end."""
        self._seconds.max = max(0.1, length_s)
        self._seconds.value = self._seconds.max
        self._seconds.disabled = False

    def look_at_now(self) -> None:
        """Take the time-line out of use."""
        self._seconds.disabled = True

    def answered(self, sentence: str) -> None:
        """Say what a service answered."""
        if self._answered is not None:
            self._answered.content = panel_text.answered(sentence)


def _share(value: Any) -> tuple[float, float]:
    low, high = value
    return float(low), float(high)
