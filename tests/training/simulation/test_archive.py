import dataclasses

import meshio
import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import enclosed_volume
from softtissue_training.organs.tetrahedralise import signed_volumes
from softtissue_training.simulation.archive import (
    digest,
    digest_of,
    list_records,
    pack,
    read_records,
    record_name,
    write_record,
)
from softtissue_training.simulation.compact import STEP_M
from softtissue_training.simulation.record_format import (
    content_hash,
    format_compact,
    format_record,
    parse_record,
)
from softtissue_training.simulation.simulate import simulate
from softtissue_training.simulation.vtu import write_vtu
from training.coarse import COARSE


def _same(ours, theirs):
    for field in dataclasses.fields(ours):
        mine, other = getattr(ours, field.name), getattr(theirs, field.name)
        if isinstance(mine, np.ndarray):
            np.testing.assert_array_equal(mine, other)
            assert mine.dtype == other.dtype
        else:
            assert mine == other


RICH = dataclasses.replace(COARSE, load_cases=2, gravity=(0.01, 0.02), poisson_ratio=(0.3, 0.4))


@pytest.fixture(scope="module")
def rich():
    """One organ with two load cases."""
    return simulate(3, 2, RICH)


def test_record_keeps_everything(rich, tmp_path):
    record, recipe = rich, RICH
    write_record(tmp_path, record_name(2), format_record(record))
    assert [file.name for file in tmp_path.iterdir()] == ["organ_000002.npz"]
    restored = parse_record((tmp_path / "organ_000002.npz").read_bytes(), "it")
    assert (restored.recipe, restored.rejected, restored.versions, restored.seed) == (
        recipe,
        record.rejected,
        record.versions,
        (3, 2),
    )
    assert len(restored.simulations) == 2
    for ours, theirs in zip(record.simulations, restored.simulations, strict=True):
        _same(ours, theirs)


def test_packed_file_holds_the_same_records(data_folder, tmp_path):
    packed = tmp_path / "sims.pack"
    assert pack(data_folder, packed) == 6
    names = list_records(packed)
    assert names == list_records(data_folder)
    assert list(read_records(packed, names)) == list(read_records(data_folder, names))


def test_a_cut_record_is_refused(records):
    content = format_record(records[0])
    with pytest.raises(InvalidInputError, match="half must be a complete simulation record"):
        parse_record(content[: len(content) // 2], "half")


def test_missing_and_foreign_data_are_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="does not exist"):
        list_records(tmp_path / "nothing")
    (tmp_path / "text").write_text("no archive")
    with pytest.raises(InvalidInputError, match="softtissue-train pack"):
        list_records(tmp_path / "text")
    with pytest.raises(InvalidInputError, match="got none"):
        pack(tmp_path, tmp_path / "packed")


def test_content_hash_sees_every_array_and_the_recipe_but_not_versions(records):
    record = records[0]
    before = content_hash(format_record(record), "it")
    assert content_hash(format_record(dataclasses.replace(record, versions={"numpy": "0"})), "it") == before
    sample = record.simulations[0]
    for name in ("vertices", "tets", "faces", "attached", "force", "displacement", "pressure", "gravity"):
        changed = np.array(getattr(sample, name))
        # The last attached vertex is dropped; elsewhere a number changes by the least amount.
        changed = changed[:-1] if name == "attached" else changed
        if name != "attached":
            first = (0,) * changed.ndim
            step = 1 if changed.dtype.kind == "i" else np.spacing(changed[first])
            changed[first] += step
        other = dataclasses.replace(sample, **{name: changed})
        content = format_record(dataclasses.replace(record, simulations=(other,)))
        assert content_hash(content, "it") != before, name
    recipe = dataclasses.replace(record.recipe, force_n=(0.0, 0.5))
    assert content_hash(format_record(dataclasses.replace(record, recipe=recipe)), "it") != before


def test_digest_depends_on_content_and_not_on_order():
    assert digest({"a": "1", "b": "2"}) == digest({"b": "2", "a": "1"})
    assert digest({"a": "1", "b": "2"}) != digest({"a": "1", "b": "3"})


def _triangles(sample):
    return {tuple(sorted(triangle)) for triangle in sample.faces.tolist()}


def test_compact_record_keeps_everything_but_the_last_micrometres(rich):
    pressed = [
        dataclasses.replace(
            sample, pressure=np.where(np.arange(len(sample.faces)) < 5, np.float32(12.5), np.float32(0.0))
        )
        for sample in rich.simulations
    ]
    record = dataclasses.replace(rich, simulations=tuple(pressed))
    content = format_compact(record)
    assert len(content) < 0.5 * len(format_record(record))
    restored = parse_record(content, "it")
    assert (restored.recipe, restored.rejected, restored.versions) == (
        record.recipe,
        record.rejected,
        record.versions,
    )
    for ours, theirs in zip(record.simulations, restored.simulations, strict=True):
        assert (ours.seed, ours.case, ours.material, ours.residual) == (
            theirs.seed,
            theirs.case,
            theirs.material,
            theirs.residual,
        )
        np.testing.assert_allclose(theirs.vertices, ours.vertices, atol=0.51 * STEP_M)
        np.testing.assert_allclose(theirs.displacement, ours.displacement, atol=0.51 * STEP_M)
        for name in ("attached", "force", "gravity"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
        assert {tuple(sorted(tet)) for tet in ours.tets.tolist()} == {
            tuple(sorted(tet)) for tet in theirs.tets.tolist()
        }
        assert signed_volumes(theirs.vertices.astype(float), theirs.tets.astype(int)).min() > 0.0
        assert _triangles(ours) == _triangles(theirs)
        ours_pressed = {tuple(sorted(face)) for face in ours.faces[ours.pressure > 0].tolist()}
        assert ours_pressed == {tuple(sorted(face)) for face in theirs.faces[theirs.pressure > 0].tolist()}
        assert enclosed_volume(theirs.surface) == pytest.approx(enclosed_volume(ours.surface), rel=1e-4)


def test_a_damaged_compact_record_is_refused(rich):
    content = format_compact(rich)
    for damaged in (content[: len(content) // 2], content[:-9] + bytes(9), content[:20]):
        with pytest.raises(InvalidInputError, match="it must be a complete simulation record"):
            parse_record(damaged, "it")


def test_compact_file_is_read_like_any_other(data_folder, tmp_path):
    packed = tmp_path / "sims.pack"
    assert pack(data_folder, packed, compact=True) == 6
    names = list_records(packed)
    assert names[0] == "organ_000000.sim"
    first = parse_record(next(iter(read_records(packed, names))), names[0])
    assert first.seed == (3, 0)


def test_digest_is_of_content_wherever_it_lies(data_folder, tmp_path):
    pack(data_folder, tmp_path / "sims.pack")
    value, count = digest_of(data_folder)
    assert (value, count) == digest_of(tmp_path / "sims.pack")
    assert count == 6
    with pytest.raises(InvalidInputError, match="must hold simulations, got none"):
        digest_of(tmp_path)


def test_vtu_file_says_what_the_record_says(rich, tmp_path):
    paths = write_vtu(tmp_path / "vtu", rich)
    assert [path.name for path in paths] == ["organ_000002_case_0.vtu", "organ_000002_case_1.vtu"]
    mesh = meshio.read(paths[1])
    sample = rich.simulations[1]
    np.testing.assert_array_equal(mesh.points, sample.vertices)
    np.testing.assert_array_equal(mesh.cells_dict["tetra"], sample.tets)
    np.testing.assert_array_equal(mesh.point_data["displacement"], sample.displacement)
    np.testing.assert_array_equal(mesh.point_data["force"], sample.force)
    np.testing.assert_array_equal(np.flatnonzero(mesh.point_data["attached"]), sample.attached)
