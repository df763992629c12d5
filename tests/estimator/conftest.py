"""What the tests of the core share."""

import pytest

from estimator.organ_folders import LIVER, TUMOUR, VEIN, export


@pytest.fixture
def folder(tmp_path):
    """Folder with the meshes of an organ, for `organ_folders.describe` to describe."""
    export(LIVER, tmp_path / "liver.ply")
    export(TUMOUR, tmp_path / "tumour.ply")
    export(VEIN, tmp_path / "vein.ply")
    return tmp_path
