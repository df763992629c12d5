"""What the mesh changes of an answer, in figures that are known."""

import json

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.cli import main
from softtissue_training.experiments.phantom import mesh_spread
from softtissue_training.experiments.phantom.mesh_spread import (
    observations_of,
    spread,
    true_displacement,
    with_tetrahedra,
)
from softtissue_training.experiments.phantom.own_case import own_phantom_case


@pytest.fixture(scope="module")
def case():
    return own_phantom_case()


def test_spread_is_that_of_one_component_over_meshes():
    drawn = np.random.default_rng(0).normal(scale=[0.001, 0.002, 0.003], size=(5, 4000, 3))
    found = spread(drawn, np.full((5, 4000), 0.004))
    assert found["spread_mm"] == pytest.approx(np.sqrt(14.0 / 3.0), rel=0.02)
    assert found["sigma_mm"] == pytest.approx(4.0)
    assert found["ratio"] == pytest.approx(found["spread_mm"] / 4.0)
    assert found["beyond_sigma_percent"] < 1.0
    assert spread(drawn, np.full((5, 4000), 0.0005))["beyond_sigma_percent"] > 99.0
    assert spread(drawn[:1].repeat(3, axis=0), np.ones((3, 4000)))["spread_mm"] == pytest.approx(0.0)


def test_patches_see_the_same_deformation_from_other_sides(case):
    observed = observations_of(case, 3)
    assert list(observed) == ["recorded", "patch 1", "patch 2", "patch 3"]
    surface = case.organ.surface.vertices
    moved = true_displacement(case)[len(case.organ.structure_points) :]
    patches = [observation for name, observation in observed.items() if name != "recorded"]
    for observation in patches:
        noise = []
        for place, displacement in zip(observation.reference, observation.displacement, strict=True):
            vertex = np.linalg.norm(surface - place, axis=1).argmin()
            noise.append(displacement - moved[vertex])
        assert np.std(noise) == pytest.approx(case.sigma_m, rel=0.1)
    middles = [observation.reference.mean(axis=0) for observation in patches]
    assert min(np.linalg.norm(middles[i] - middles[i - 1]) for i in range(3)) > 0.05


def test_organ_with_other_tetrahedra_differs_in_them_alone(case):
    mesh = case.organ.tetrahedra
    moved = type(mesh)(mesh.nodes + 1e-5, mesh.tets)
    other = with_tetrahedra(case.organ, moved)
    assert other.tetrahedra is moved
    assert other.geometry_digest != case.organ.geometry_digest
    assert with_tetrahedra(other, mesh).digest == case.organ.digest


def test_command_writes_and_prints_what_was_measured(case, monkeypatch, tmp_path, capsys):
    """Answers that are off by 1, 2 and 3 mm along x on three fresh meshes, exact on the one that is named."""
    offsets = iter([0.001, 0.002, 0.003, 0.0])

    def answers(organ, mesh, observations, progress):
        off = [next(offsets), 0.0, 0.0]
        count = len(observations)
        return np.repeat(true_displacement(case)[None] + off, count, axis=0), np.full(
            (count, len(organ.query_points)), 0.001
        )

    monkeypatch.setattr(mesh_spread, "answers", answers)
    monkeypatch.setattr(mesh_spread, "tetrahedralise", lambda surface, progress: case.organ.tetrahedra)
    out = tmp_path / "more" / "spread.json"
    assert main(["mesh-spread", "--meshes", "3", "--patches", "1", "--out", str(out)]) == 0
    found = json.loads(out.read_text())["observations"]
    assert list(found) == ["recorded", "patch 1", "all"]
    for row in found.values():
        assert row["spread_mm"] == pytest.approx(np.sqrt(1.0 / 3.0))
        assert row["error_mm"] == [1.0, 2.0, 3.0]
        assert row["error_named_mm"] == [0.0]
    assert "| all | 0.58 | 1.00 | 0.58 | 0 % | 1.0, 2.0, 3.0 | 0.0 |" in capsys.readouterr().out


def test_one_mesh_alone_has_no_spread():
    with pytest.raises(InvalidInputError, match="at least 2, got 1"):
        mesh_spread.measure(1, 1, print)
