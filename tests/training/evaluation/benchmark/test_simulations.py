"""What the benchmark simulates: given organs, one load with several materials, seeds that nothing else uses."""

import signal
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.cli import main
from softtissue_training.evaluation.benchmark.plan import NamedSurface, make_plan
from softtissue_training.organs.tetrahedralise import tetrahedralise
from softtissue_training.physics.material import Material
from softtissue_training.physics.solver import solve
from softtissue_training.simulation import cluster
from softtissue_training.simulation.archive import list_records, read_records
from softtissue_training.simulation.generate import generate
from softtissue_training.simulation.record_format import parse_record
from softtissue_training.simulation.reserved_seeds import FIRST_RESERVED_SEED, check_not_reserved
from softtissue_training.simulation.simulate import simulate
from training.coarse import COARSE

MATERIALS = (
    Material(),
    Material(poisson_ratio=0.45),
    Material("st_venant_kirchhoff", poisson_ratio=0.30),
)


@pytest.fixture(scope="module")
def swept():
    return simulate(3, 1, COARSE, materials=MATERIALS)


@pytest.fixture(scope="module")
def ball():
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    return tetrahedralise(SurfaceMesh(np.asarray(sphere.vertices), np.asarray(sphere.faces)), 0.02)


def test_a_sweep_changes_the_material_and_nothing_else(swept):
    first = swept.simulations[0]
    assert tuple(sample.material for sample in swept.simulations) == MATERIALS
    assert [sample.case for sample in swept.simulations] == [0, 1, 2]
    for sample in swept.simulations[1:]:
        for name in ("vertices", "tets", "attached", "force", "pressure", "gravity"):
            assert np.array_equal(getattr(sample, name), getattr(first, name))
        assert np.linalg.norm(sample.displacement - first.displacement, axis=1).max() > 1e-4


def test_each_material_has_its_own_equilibrium(swept):
    for sample in swept.simulations:
        nodes = sample.vertices.astype(np.float64)
        fixed = np.zeros(len(nodes), dtype=bool)
        fixed[sample.attached] = True
        load = sample.force.astype(np.float64)
        found = solve(nodes, sample.tets.astype(np.int64), fixed, load, sample.material)
        # Vertices and loads are stored in single precision.
        assert np.abs(found.displacement - sample.displacement).max() < 2e-5


def test_the_papers_material_gives_the_simulation_without_a_sweep(swept, records):
    assert swept.rejected == records[1].rejected
    assert np.array_equal(swept.simulations[0].displacement, records[1].simulations[0].displacement)


def test_a_given_organ_is_attached_and_loaded_anew_in_each_record(ball, tmp_path):
    generate(tmp_path, 2, 5, COARSE, mesh=ball, show_progress=False)
    found = [parse_record(content, "") for content in read_records(tmp_path, list_records(tmp_path))]
    first, second = (record.simulations[0] for record in found)
    for sample in (first, second):
        assert np.array_equal(sample.vertices, ball.vertices.astype(np.float32))
        assert np.abs(sample.displacement[sample.attached]).max() == 0.0
        assert np.linalg.norm(sample.displacement, axis=1).max() > 1e-4
    assert not np.array_equal(first.attached, second.attached)
    assert not np.array_equal(first.force, second.force)


def test_other_organs_and_materials_are_not_mixed(ball, data_folder):
    for other in ({"mesh": ball}, {"materials": MATERIALS}):
        with pytest.raises(InvalidInputError, match="of the organ and the materials asked for"):
            generate(data_folder, 6, 3, COARSE, show_progress=False, **other)


def test_generate_refuses_the_seeds_of_the_benchmark(tmp_path, capsys):
    check_not_reserved(FIRST_RESERVED_SEED - 1)
    arguments = [
        "generate",
        "--count",
        "1",
        "--seed",
        str(FIRST_RESERVED_SEED),
        "--out",
        str(tmp_path / "sims"),
    ]
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert "expected below 1000000" in said and "got 1000000" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "sims").exists()


def test_workers_leave_ctrl_c_to_the_process_that_started_them():
    """A terminal sends it to all of them; the workers would die with a traceback each."""
    show = [sys.executable, "-c", "import signal; print(signal.getsignal(signal.SIGINT) is signal.SIG_IGN)"]
    # Started in the background by a shell, the tests themselves ignore it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with cluster._no_interrupt_for_children():
            inside = subprocess.run(show, capture_output=True, text=True, check=True).stdout
        after = subprocess.run(show, capture_output=True, text=True, check=True).stdout
    finally:
        signal.signal(signal.SIGINT, before)
    assert (inside.strip(), after.strip()) == ("True", "False")


def test_the_benchmark_uses_reserved_seeds_alone(tmp_path):
    surfaces = {suite: NamedSurface(tmp_path / suite, 1e-3) for suite in ("own", "user")}
    plan = make_plan(("random", "own", "user"), surfaces)
    assert all(data.seed >= FIRST_RESERVED_SEED for data in plan.data_sets)
    assert len({data.name for data in plan.data_sets}) == len(plan.data_sets)
    assert {data.name: data.organs for data in plan.data_sets}["user"] == 1334
