"""`organ.yaml`: every mistake is one sentence."""

import numpy as np
import pytest

from estimator.organ_folders import TIP, describe
from softtissue_estimator.errors import OrganError
from softtissue_estimator.organ.organ import load_organ

BAD_STRUCTURE = [{"name": "x", "mesh": "tumour.ply", "colour": [2, 0, 0]}]


MISTAKES = [
    (
        {"landmarks": [1, 2, 3]},
        OrganError,
        r"landmarks: expected names with three numbers each, got \[1, 2, 3\]",
    ),
    ({"landmarks": {"tip": [1, 2]}}, OrganError, r"landmarks.tip: expected 3 numbers, got \[1, 2\]"),
    ({"landmarks": {"": [1, 2, 3]}}, OrganError, "landmarks: expected names of 1 to 64 letters, got ''"),
    (
        {"landmarks": {"far": [0, 0, 900]}},
        OrganError,
        r"landmarks, 'far': expected a place within 10 mm of the surface, got one \d+ mm away",
    ),
    ({"unit": None}, OrganError, "unit: expected mm or m, got nothing"),
    ({"unit": "cm"}, OrganError, "unit: expected mm or m, got 'cm'"),
    (
        {"unit": "m"},
        OrganError,
        r"got 1.1\de\+09 litres .* with unit m; .*, in mm it would be 1.1\d litres: state mm",
    ),
    (
        {"frame": "/organ"},
        OrganError,
        "frame: expected a name without a leading slash, .*did you mean 'organ'",
    ),
    ({"surfaces": "x.ply"}, OrganError, "surfaces: unknown key, expected one of attached"),
    ({"surface": None}, OrganError, "surface: expected a file name, got nothing"),
    ({"surface": "none.ply"}, OrganError, "surface: expected a file, found none at"),
    ({"structures": "tumour.ply"}, OrganError, "structures: expected a list, got 'tumour.ply'"),
    ({"structures": [{"name": "x"}]}, OrganError, r"structures\[0\].mesh: expected a file name, got nothing"),
    (
        {"structures": [{"mesh": "tumour.ply"}]},
        OrganError,
        r"structures\[0\].name: expected text, got nothing",
    ),
    ({"structures": BAD_STRUCTURE}, OrganError, r"colour: expected numbers from 0 to 1, got \[2, 0, 0\]"),
    (
        {"structures": [{"name": "x", "mesh": "none.ply"}]},
        OrganError,
        r"structures\[0\].mesh: expected a file",
    ),
    (
        {"attached": {"spheres": [*TIP["spheres"], {"centre": [500, 0, 0], "radius": 5}]}},
        OrganError,
        r"spheres\[1\]: expected surface vertices within its reach, got none, the nearest 405 mm beyond it",
    ),
    ({"attached": {"spheres": [{"centre": [0, 0, 0], "radius": 500}]}}, OrganError, "got all of them"),
    (
        {"attached": {"spheres": [{"centre": [0, 0, 1e308], "radius": 5}]}},
        OrganError,
        "centre: expected numbers of at most 1e.09, got .0, 0, 1e.308.",
    ),
    (
        {"attached": {"patch": {"centre": [-1e300, 0, 0], "share": 0.1}}},
        OrganError,
        "numbers of at most 1e.09",
    ),
    ({"attached": {"spheres": [{"centre": [0, 0], "radius": 5}]}}, OrganError, "centre: expected 3 numbers"),
    (
        {"attached": {"spheres": [{"centre": [0, 0, 0]}]}},
        OrganError,
        "radius: expected a positive number, got nothing",
    ),
    (
        {"attached": {"spheres": [{"centre": [0, 0, 0], "radius": -1}]}},
        OrganError,
        "expected a positive number",
    ),
    (
        {"attached": {"vertices": [1, 100000]}},
        OrganError,
        r"expected indices from 0 to 641 \(.*is 0\), got 1 to 100000",
    ),
    ({"attached": {"vertices": ["a"]}}, OrganError, "expected whole numbers"),
    ({"attached": {"vertices": "none.txt"}}, OrganError, "expected a file, found none"),
    (
        {"attached": {"touching": {"mesh": "vein.ply"}}},
        OrganError,
        "distance: expected a positive number, got nothing",
    ),
    ({"attached": {"circles": []}}, OrganError, "attached.circles: unknown key"),
]


@pytest.mark.parametrize(("changes", "kind", "message"), MISTAKES, ids=lambda value: str(value)[:40])
def test_mistakes_are_one_sentence(folder, changes, kind, message):
    with pytest.raises(kind, match=message) as caught:
        load_organ(describe(folder, **changes))
    assert "\n" not in str(caught.value)


def test_landmarks_are_places_of_the_surface(folder):
    surface = load_organ(describe(folder)).surface
    first, last = surface.vertices[3], surface.vertices[-1]
    named = {"tip": [float(x) for x in 1e3 * first], " notch ": [float(x) for x in 1e3 * last]}
    organ = load_organ(describe(folder, landmarks=named))
    assert set(organ.landmarks) == {"tip", "notch"}
    np.testing.assert_allclose(organ.landmarks["tip"], first, atol=1e-9)
    free = organ.with_attached(np.zeros(len(surface.vertices), dtype=bool))
    np.testing.assert_allclose(free.landmarks["notch"], last, atol=1e-9)


@pytest.mark.parametrize("text", ["[1, 2", "- a\n- b\n", "", "\x00"])
def test_file_that_is_no_description_is_refused(folder, text):
    (folder / "organ.yaml").write_text(text)
    with pytest.raises(OrganError, match=r"organ.yaml: expected"):
        load_organ(folder)


def test_folder_without_description_is_refused(tmp_path):
    with pytest.raises(OrganError, match="expected a folder with organ.yaml"):
        load_organ(tmp_path / "nothing")


def test_code_in_yaml_is_not_run(folder):
    (folder / "organ.yaml").write_text("name: !!python/object/apply:os.getcwd []\nunit: mm\n")
    with pytest.raises(OrganError, match="expected YAML"):
        load_organ(folder)
