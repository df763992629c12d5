import sys
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.image import imread

from estimator.shapes import sphere
from softtissue_estimator.errors import InvalidInputError, MissingDependencyError, SoftTissueError
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.organ.organ import Structure, make_organ
from softtissue_estimator.view.estimate_picture import draw_estimate

SHIFT = np.array([0.012, 0.0, 0.004])
FRONT = (0.0, -1.0, 0.0)


@pytest.fixture(scope="module")
def organ():
    """A ball with two balls in it, one to the left, one to the right of the middle."""
    surface = sphere(0.05, subdivisions=3)
    left, right = (
        Structure(name, "other", sphere(0.012, (x, 0.0, 0.0), 2), (0.95, 0.85, 0.2, 1.0))
        for name, x in (("left", -0.02), ("right", 0.02))
    )
    return make_organ("ball", "organ", surface, (left, right), surface.vertices[:, 1] > 0.04)


@pytest.fixture(scope="module")
def observation(organ):
    reference = organ.surface.vertices[organ.surface.vertices[:, 1] < -0.04]
    return Observation(reference, np.broadcast_to(SHIFT, reference.shape), np.full(len(reference), 0.001))


def estimate(organ, sigma):
    displacement = np.broadcast_to(SHIFT, organ.query_points.shape)
    return SimpleNamespace(displacement=displacement, sigma=sigma)


def drawn(path, *arguments):
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("DISPLAY", raising=False)
        patch.setattr("softtissue_estimator.view.panels._PANEL", (500, 700))
        draw_estimate(path, *arguments, direction=FRONT)
    return imread(path)


def test_colour_of_a_structure_tells_its_standard_deviation(organ, observation, tmp_path):
    sigma = np.where(organ.query_points[:, 0] < 0.0, 0.0002, 0.002)
    image = drawn(tmp_path / "new" / "sigma.png", organ, observation, estimate(organ, sigma))
    width = image.shape[1] // 3
    panel = image[int(0.15 * len(image)) : int(0.7 * len(image)), 2 * width :, :3]
    violet = (panel[..., 2] > panel[..., 1] + 0.1) & (panel.max(axis=-1) < 0.6)  # the scale's lower end
    yellow = (
        (panel[..., 0] > 0.45) & (panel[..., 1] > 0.4) & (panel[..., 2] < 0.35 * panel[..., 0])
    )  # its upper
    assert violet.sum() > 300 and yellow.sum() > 300
    assert np.argwhere(violet)[:, 1].max() < np.argwhere(yellow)[:, 1].min()


def test_without_a_standard_deviation_there_are_two_panels(organ, observation, tmp_path):
    image = drawn(str(tmp_path / "two.png"), organ, observation, estimate(organ, None))
    assert image.shape[1] / image.shape[0] == pytest.approx(2 * 6.6 / 6.2, abs=0.01)


def test_estimate_of_another_organ_is_refused(organ, observation, tmp_path):
    other = SimpleNamespace(displacement=np.zeros((5, 3)), sigma=None)
    with pytest.raises(InvalidInputError, match=r"estimate of organ 'ball' .*, got \(5, 3\)"):
        draw_estimate(tmp_path / "other.png", organ, observation, other)


def test_missing_matplotlib_is_a_sentence(organ, observation, tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingDependencyError, match="picture: expected matplotlib, got none") as caught:
        draw_estimate(tmp_path / "none.png", organ, observation, estimate(organ, None))
    assert isinstance(caught.value, SoftTissueError) and isinstance(caught.value, ImportError)
