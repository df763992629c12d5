"""A sample of `make fuzz`: damaged files and messages of every kind are borne; and what is not borne is noticed."""

import json
import random

import pytest

from fuzz import wrong_digits
from fuzz.campaign import main, replay
from fuzz.kind import FailedError, Kind, MissingError, check_sentence, make_input, try_input, try_inputs
from fuzz.kinds import KINDS, inputs_of
from softtissue_estimator.errors import InvalidInputError

SEED = 20
# A second or two each.
SAMPLES = {
    "meshes": 150,
    "library meshes": 25,
    "tetrahedra": 15,
    "yaml files": 120,
    "tables": 250,
    "cached files": 120,
    "weights": 60,
    "bags": 40,
    "messages": 50,
    "images": 150,
    "pages": 100,
    "over DDS": 2,
}


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name.replace(" ", "_"))
def test_damaged_input_is_borne(kind, tmp_path):
    try:
        tried = kind(tmp_path)
    except MissingError as missing:
        pytest.skip(str(missing))
    try:
        failures = [
            failure for _, _, failure in try_inputs(tried, SEED, range(SAMPLES[kind.name])) if failure
        ]
    finally:
        tried.close()
    assert not failures, f"seed {SEED}, {failures[0].kind} {failures[0].index}: {failures[0].why}"


class Doubtful(Kind):
    """Bears some inputs and others not."""

    name = "tables"

    def make(self, rng):
        return f"{rng.choice(('sentence', 'crash', 'large', 'fine', 'wrong'))}.csv", rng.randbytes(8)

    def run(self, name, content):
        what = name.removesuffix(".csv")
        if what == "sentence":
            raise InvalidInputError("expected a\ntable, got " + 500 * "x")
        if what == "crash":
            raise ZeroDivisionError
        if what == "large":
            self.kept = bytearray(b"x" * (60 << 20))
            del self.kept
        if what == "wrong":
            raise FailedError("it is another organ")
        return "read"

    good = True

    def check_good(self):
        if not self.good:
            raise FailedError("the undamaged file is refused")


@pytest.mark.parametrize(
    ("name", "outcome", "why"),
    [
        ("fine", "read", ""),
        ("sentence", "refused", ""),
        ("crash", "failed", "ZeroDivisionError"),
        ("wrong", "failed", "another organ"),
        ("large", "failed", "MiB of memory"),
    ],
)
def test_what_is_not_borne_is_noticed(tmp_path, monkeypatch, name, outcome, why):
    monkeypatch.setattr("fuzz.kind.MOST_BYTES", 30 << 20)
    found = try_input(Doubtful(tmp_path), f"{name}.csv", b"")
    assert found[0] == outcome and why in found[1]


def test_a_good_input_that_is_refused_afterwards_is_noticed(tmp_path):
    kind = Doubtful(tmp_path)
    kind.good = False
    kind.make = lambda rng: ("fine.csv", b"")
    ((_, outcome, failure),) = try_inputs(kind, SEED, range(7, 8))
    assert (outcome, failure.index) == ("failed", 7)
    assert "afterwards: the undamaged file is refused" in failure.why


@pytest.mark.parametrize("text", ["", "a\nb", "a\x1b[2J", 301 * "x"])
def test_what_is_no_sentence_is_noticed(text):
    check_sentence(300 * "x")
    with pytest.raises(FailedError, match="expected a printable line"):
        check_sentence(text)


def test_a_number_gives_the_same_input_every_time(tmp_path):
    kinds = [kind for kind in KINDS if kind.name in ("meshes", "tables", "weights", "cached files")]
    for kind in kinds:
        inputs = []
        for attempt in range(2):
            folder = tmp_path / f"{kind.name}{attempt}"
            folder.mkdir()
            made = kind(folder)
            inputs.append([make_input(made, SEED, index) for index in range(20)])
            made.close()
        assert inputs[0] == inputs[1]
        assert len(set(inputs[0])) > 15


def test_damage_does_not_depend_on_what_was_drawn_before(tmp_path):
    kind = Doubtful(tmp_path)
    random.seed(5)
    late = make_input(kind, 1, 3)
    assert [make_input(kind, 1, index) for index in range(4)][3] == late


def test_all_kinds_make_the_number_of_inputs():
    total = sum(inputs_of(kind, 100_000) * kind.each for kind in KINDS)
    assert total == pytest.approx(100_000, rel=0.001)


def test_campaign_goes_on_where_it_was_and_keeps_nothing_of_what_is_borne(tmp_path, capsys):
    arguments = ["--count", "500", "--seed", "3", "--kind", "tables", "--out", str(tmp_path)]
    assert main(arguments) == 0
    whole = json.loads((tmp_path / "progress.json").read_text())
    count = whole["kinds"]["tables"]["done"]
    assert count == inputs_of(next(kind for kind in KINDS if kind.name == "tables"), 500)
    assert [path.name for path in tmp_path.iterdir()] == ["progress.json"]
    half = {**whole, "complete": False}
    half["kinds"]["tables"] |= {"done": count - 10, "outcomes": {"read": count - 10}}
    (tmp_path / "progress.json").write_text(json.dumps(half))
    capsys.readouterr()
    assert main(arguments) == 0
    assert "Continuing what was begun" in capsys.readouterr().out
    again = json.loads((tmp_path / "progress.json").read_text())["kinds"]["tables"]
    assert again["done"] == count and sum(again["outcomes"].values()) == count
    kept = tmp_path / "tables-3-0-comma.csv"
    kept.write_bytes(b"label,x,y,z\na,1,2\n")
    assert replay(kept) == 0


def test_wrong_digits_that_matter_are_said(tmp_path):
    found = wrong_digits.count(100, tmp_path)
    assert found["moved far"] >= 5
    assert found["of these said"] >= 0.8 * found["moved far"]
    assert found["volume changed in silence"] == 0
