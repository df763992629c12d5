import sys

import numpy as np
import pytest
from matplotlib.image import imread

from estimator.shapes import sphere
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.organ import Structure, make_organ
from softtissue_estimator.view.picture import Markers, Scene, draw_phantom

SHIFT = np.array([0.012, 0.0, 0.004])


@pytest.fixture(scope="module")
def organ():
    surface = sphere(0.05, subdivisions=3)
    tumour = Structure("tumour", "tumour", sphere(0.012, (0.01, 0.0, 0.02), 2), (0.95, 0.85, 0.2, 1.0))
    vessel = Structure("vein", "vessel", sphere(0.008, (-0.02, 0.0, 0.0), 2), (0.2, 0.3, 0.9, 1.0))
    return make_organ("ball", "organ", surface, (tumour, vessel), surface.vertices[:, 1] > 0.04)


@pytest.fixture(scope="module")
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


@pytest.fixture(scope="module")
def pictures(scene, tmp_path_factory):
    """Small pictures of an estimate that is off by 1.3 mm, of an exact one, and of structures without a truth."""
    folder = tmp_path_factory.mktemp("pictures") / "new"
    alone = scene.estimated[: len(scene.organ.structure_points)]
    front = (0.0, -1.0, 0.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("DISPLAY", raising=False)
        patch.setattr("softtissue_estimator.view.picture._PANEL", (500, 700))
        draw_phantom(folder / "off.png", scene, title="A ball", caption="shifted", direction=front)
        exact = replaced(scene, estimated=scene.true, markers=None)
        draw_phantom(folder / "exact.png", exact, direction=front)
        unknown = replaced(scene, estimated=alone, true=None, markers=None)
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


def test_estimate_of_the_structures_alone_takes_the_true_surface_if_there_is_one(scene):
    alone = replaced(scene, estimated=scene.estimated[: len(scene.organ.structure_points)])
    np.testing.assert_allclose(alone.surface.vertices, scene.organ.surface.vertices + SHIFT)
    np.testing.assert_allclose(scene.surface.vertices, scene.organ.surface.vertices + 0.9 * SHIFT)
    assert replaced(alone, true=None).surface is None


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
    monkeypatch.delitem(sys.modules, "softtissue_estimator.view.picture")
    import softtissue_estimator.view.picture as again

    assert again.draw_phantom.__doc__
