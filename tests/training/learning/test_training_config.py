"""Named configurations, and settings that are refused."""

import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.paper.network_spec import CHANNELS, OBSERVED, PAPER_SCALES, NetworkSpec
from softtissue_training.learning.training_config import CONFIGS, get_config


@pytest.mark.parametrize("name", CONFIGS)
def test_only_the_published_recipe_is_in_the_organs_frame(name):
    config = get_config(name)
    assert config.name == name
    published = name == "paper-original"
    assert config.spec.frame == ("organ" if published else "rigid")
    assert config.spec.channels == (CHANNELS if published else (*CHANNELS, OBSERVED))
    assert config.spec.gives_sigma is not published


def test_the_published_recipe_sees_exactly_what_is_visible():
    config = get_config("paper-original")
    assert config.loss == "squared" and config.orientations == 8
    assert config.noise_m == (0.0, 0.0) and config.correspondences is None
    assert config.misregistered == config.misattached == 0.0 and config.common_share is None
    assert config.spec.spacing == pytest.approx(0.30 / 64)
    assert config.spec.input_scales == pytest.approx([50.0 * scale for scale in PAPER_SCALES])
    assert config.spec.architecture == NetworkSpec().architecture


def test_the_coarse_recipe_is_the_fine_one_on_cells_of_twice_the_size():
    fine, coarse = get_config("paper"), get_config("paper-coarse")
    assert coarse.spec.spacing == pytest.approx(2.0 * fine.spec.spacing)
    assert coarse.spec.architecture == fine.spec.architecture
    drawn = ("visible_share", "common_share", "noise_m", "noisy", "correspondences", "sparse")
    wrong = ("misregistered", "misregistration", "misattached", "misattachment", "orientations")
    for name in (*drawn, *wrong, "loss", "sigma_weight"):
        assert getattr(coarse, name) == getattr(fine, name), name


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"loss": "cubic"}, "loss must be one of squared, distance, got 'cubic'"),
        ({"orientations": 24}, "orientations must be 1, 8 or 48, got 24"),
        ({"ema_decay": 1.0}, "ema_decay must be at least 0 and below 1, got 1.0"),
        ({"visible_share": (0.0, 1.0)}, "visible_share must be two shares"),
        ({"noise_m": (0.002, 0.001)}, "noise must be a range from low to high"),
        ({"correspondences": (0, 5)}, "correspondences must be a range from low to high"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        get_config("tiny", **changes)
