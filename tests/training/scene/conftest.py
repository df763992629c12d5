"""The small scene, made once."""

import pytest

from softtissue_training.scene.build import build_scene
from training.scene_cases import SPEC, Made, read_messages


@pytest.fixture(scope="session")
def made(tmp_path_factory) -> Made:
    folder = tmp_path_factory.mktemp("scene")
    scene, figures = build_scene(SPEC, folder)
    return Made(scene, figures, folder / "bags" / "laparoscope")


@pytest.fixture(scope="session")
def messages(made):
    return read_messages(made.bag)
