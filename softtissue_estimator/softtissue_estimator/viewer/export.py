"""A recording as one HTML file, which opens in a browser without ROS, without this software and without a network."""

from itertools import pairwise

from softtissue_estimator.view.structures import Structures
from softtissue_estimator.viewer.colours import colours
from softtissue_estimator.viewer.moment import Moment
from softtissue_estimator.viewer.scene import Look, Scene
from softtissue_estimator.viewer.server import LOOPBACK, PageServer

_LONGEST_GAP_S = 2.0
"""Nobody waits longer for the next moment where nothing was answered in between."""


def recording_page(
    structures: Structures, moments: tuple[Moment, ...], sigma_scale_m: float | None = None
) -> str:
    """Return the HTML of a page that plays a recording, with a time-line.

    Parameters
    ----------
    structures : Structures
    moments : tuple of Moment
        At least one, the oldest first.
    sigma_scale_m : float, optional
        Colour the structures by their standard deviations; the last colour of the scale is that of this one, m.
    """
    # A server that nobody knows of: viser writes down what it would send.
    server = PageServer(LOOPBACK, 0)
    try:
        scene = Scene(server)

        def show(moment: Moment) -> None:
            sigma = None if sigma_scale_m is None else moment.sigma
            scene.show(structures, moment, Look(tuple(colours(structures, sigma, sigma_scale_m or 1.0))))

        show(moments[0])
        writer = server.get_scene_serializer()
        for before, moment in pairwise(moments):
            writer.insert_sleep(min(_LONGEST_GAP_S, max(0.0, moment.time_s - before.time_s)))
            show(moment)
        return str(writer.as_html(dark_mode=True))
    finally:
        server.stop()
