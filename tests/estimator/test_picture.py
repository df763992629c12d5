import sys

import numpy as np
import pytest
from matplotlib.image import imread

from estimator.shapes import sphere
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ import Structure, make_organ
from softtissue_estimator.picture import Markers, Scene, draw_phantom

SHIFT = np.array([0.012, 0.0, 0.004])


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    monkeypatch.setattr("softtissue_estimator.picture._PANEL", (500, 700))


@pytest.fixture(scope="module")
def organ():
    surface = sphere(0.05, subdivisions=3)
    tumour = Structure("tumour", "tumour", sphere(0.012, (0.01, 0.0, 0.02), 2), (0.95, 0.85, 0.2, 1.0))
    vessel = Structure("vein", "vessel", sphere(0.008, (-0.02, 0.0, 0.0), 2), (0.2, 0.3, 0.9, 1.0))
    return make_organ("ball", "organ", surface, (tumour, vessel), surface.vertices[:, 1] > 0.04)


@pytest.fixture
def scene(organ):
    reference = organ.surface.vertices[organ.surface.vertices[:, 1] < -0.04]
    inner = np.array([[0.01, 0.0, 0.01], [-0.01, 0.0, -0.02]])
    return Scene(
        organ=organ,
        reference=reference,
        observed=reference + SHIFT,
        estimated=organ.query_points + 0.9 * SHIFT,
        true=organ.query_points + SHIFT,
        markers=Markers(inner, inner + 0.9 * SHIFT, inner + SHIFT),
    )


def replaced(scene, **changes):
    values = {name: getattr(scene, name) for name in scene.__dataclass_fields__}
    return Scene(**{**values, **changes})


def panel(image, number, of):
    width = image.shape[1] // of
    return image[int(0.15 * len(image)) : int(0.8 * len(image)), number * width : (number + 1) * width, :3]


def yellow(pixels):
    """Whether pixels are saturated yellow, as the tumour is and nothing else."""
    return (pixels[..., 0] > 0.45) & (pixels[..., 1] > 0.4) & (pixels[..., 2] < 0.35 * pixels[..., 0])


def test_three_panels_show_the_tumour_where_it_was_and_where_it_is_estimated(scene, tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    path = tmp_path / "new" / "picture.png"
    draw_phantom(path, scene, title="A ball", caption="shifted", direction=(0.0, -1.0, 0.0))
    image = imread(path)
    before, during = (yellow(panel(image, number, 3)) for number in range(2))
    assert before.sum() > 500
    assert during.sum() > 500
    centre = [np.argwhere(part).mean(axis=0) for part in (before, during)]
    # Seen from the front, the shift is to the right (more columns) and upwards (fewer rows), three to one.
    moved = centre[1] - centre[0]
    assert moved[1] > 10.0
    assert moved[0] / moved[1] == pytest.approx(-1.0 / 3.0, abs=0.12)


def dark(path):
    """Count of dark violet pixels, the lowest colours of the error's scale, above the colour bar."""
    drawn = panel(imread(path), 2, 3)
    pixels = drawn[: int(0.7 * len(drawn))]
    return np.count_nonzero((pixels.max(axis=-1) < 0.35) & (np.ptp(pixels, axis=-1) > 0.04))


def test_colour_of_the_structures_tells_their_error(scene, tmp_path):
    draw_phantom(tmp_path / "exact.png", replaced(scene, estimated=scene.true, markers=None))
    draw_phantom(tmp_path / "off.png", replaced(scene, markers=None))
    assert dark(tmp_path / "exact.png") > 1000
    assert dark(tmp_path / "off.png") < 100


def test_without_the_truth_there_is_no_error_panel(scene, tmp_path):
    draw_phantom(tmp_path / "all.png", scene)
    draw_phantom(tmp_path / "two.png", replaced(scene, true=None, markers=None))
    whole, part = imread(tmp_path / "all.png"), imread(tmp_path / "two.png")
    assert part.shape[1] / whole.shape[1] == pytest.approx(2.0 / 3.0, abs=0.01)


def test_estimate_of_the_structures_alone_is_drawn_in_the_true_organ(scene, tmp_path):
    alone = replaced(scene, estimated=scene.estimated[: len(scene.organ.structure_points)])
    np.testing.assert_allclose(alone.surface.vertices, scene.organ.surface.vertices + SHIFT)
    np.testing.assert_allclose(scene.surface.vertices, scene.organ.surface.vertices + 0.9 * SHIFT)
    assert replaced(alone, true=None).surface is None
    draw_phantom(tmp_path / "picture.png", replaced(alone, true=None))
    assert yellow(panel(imread(tmp_path / "picture.png"), 1, 2)).sum() > 500


def test_structures_take_their_own_positions_in_order(scene):
    tumour, vessel = scene.structures(scene.estimated)
    np.testing.assert_allclose(
        tumour.vertices.mean(axis=0), np.array([0.01, 0, 0.02]) + 0.9 * SHIFT, atol=1e-6
    )
    np.testing.assert_allclose(vessel.vertices.mean(axis=0), np.array([-0.02, 0, 0]) + 0.9 * SHIFT, atol=1e-6)


@pytest.mark.parametrize("name", ["estimated", "true"])
def test_positions_that_do_not_fit_the_organ_are_refused(scene, name):
    with pytest.raises(InvalidInputError, match=rf"{name} positions: expected shape .*, got \(5, 3\)"):
        replaced(scene, **{name: np.zeros((5, 3))})


def test_module_imports_without_matplotlib(monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "softtissue_estimator.picture")
    import softtissue_estimator.picture as again

    assert again.draw_phantom.__doc__
