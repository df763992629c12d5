import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread

from estimator.drawn_scene import ball_scene
from softtissue_estimator.view.picture import draw_phantom


@pytest.fixture(scope="module")
def scene():
    return ball_scene()


@pytest.fixture(scope="module")
def pictures(scene, tmp_path_factory):
    """Small pictures of an estimate that is off by 1.3 mm, of an exact one, and of structures without a truth."""
    folder = tmp_path_factory.mktemp("pictures") / "new"
    alone = scene.estimated[: len(scene.organ.structure_points)]
    front = (0.0, -1.0, 0.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("DISPLAY", raising=False)
        patch.setattr("softtissue_estimator.view.panels._PANEL", (500, 700))
        draw_phantom(folder / "off.png", scene, title="A ball", caption="shifted", direction=front)
        exact = replace(scene, estimated=scene.true, markers=None)
        draw_phantom(folder / "exact.png", exact, direction=front)
        unknown = replace(scene, estimated=alone, true=None, markers=None)
        draw_phantom(folder / "unknown.png", unknown, direction=front)
    return {path.stem: imread(path) for path in folder.iterdir()}


def panel(image, number, of):
    width = image.shape[1] // of
    return image[int(0.15 * len(image)) : int(0.8 * len(image)), number * width : (number + 1) * width, :3]


def yellow(pixels):
    """Whether pixels are saturated yellow, as the tumour is and nothing else."""
    return (pixels[..., 0] > 0.45) & (pixels[..., 1] > 0.4) & (pixels[..., 2] < 0.35 * pixels[..., 0])


def dark(pixels):
    """Whether pixels are dark violet, the lowest colour of the error's scale, above the colour bar."""
    upper = pixels[: int(0.7 * len(pixels))]
    return (upper.max(axis=-1) < 0.35) & (np.ptp(upper, axis=-1) > 0.04)


def test_tumour_is_shown_where_it_was_and_where_it_is_estimated(pictures):
    before, during = (yellow(panel(pictures["off"], number, 3)) for number in range(2))
    assert before.sum() > 500 and during.sum() > 500
    moved = np.argwhere(during).mean(axis=0) - np.argwhere(before).mean(axis=0)
    # Seen from the front, the shift is to the right (more columns) and upwards (fewer rows), three to one.
    assert moved[1] > 10.0
    assert moved[0] / moved[1] == pytest.approx(-1.0 / 3.0, abs=0.12)


def test_colour_of_the_structures_tells_their_error(pictures):
    assert dark(panel(pictures["exact"], 2, 3)).sum() > 1000
    assert dark(panel(pictures["off"], 2, 3)).sum() < 100


def test_without_the_truth_there_are_two_panels(pictures):
    assert pictures["unknown"].shape[1] / pictures["off"].shape[1] == pytest.approx(2.0 / 3.0, abs=0.01)
    assert yellow(panel(pictures["unknown"], 1, 2)).sum() > 500


def test_module_imports_without_matplotlib(monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "softtissue_estimator.view.picture")
    monkeypatch.delitem(sys.modules, "softtissue_estimator.view.panels")
    import softtissue_estimator.view.picture as again

    assert again.draw_phantom.__doc__
