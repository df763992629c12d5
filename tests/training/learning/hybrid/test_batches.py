"""What the hybrid network learns from: stored posteriors, orientations, batches."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.learning.distributed import Ranks
from softtissue_training.learning.hybrid.batches import HybridBatchSource, collate
from softtissue_training.learning.hybrid.config import get_hybrid_config
from softtissue_training.learning.hybrid.posterior_record import format_posteriors, parse_posteriors
from softtissue_training.learning.hybrid.posterior_set import PosteriorSet
from softtissue_training.learning.hybrid.sample import hybrid_sample, oriented
from softtissue_training.learning.prefetch import prefetched
from softtissue_training.simulation.archive import record_name, write_record
from training.hybrid_cases import made_up_case, made_up_record

CONFIG = get_hybrid_config("hybrid-tiny")


def write(folder, numbers, **options):
    folder.mkdir(exist_ok=True)
    for number in numbers:
        record = made_up_record(number, CONFIG.spec, **options)
        write_record(folder, record_name(number), format_posteriors(record))
    return folder


def turned(case, order, mirrored):
    """The same case in a coordinate system with other axes, everything computed anew from that."""
    sign = np.ones(3)
    sign[list(mirrored)] = -1.0

    def vectors(values):
        return (values[..., list(order)] * sign).astype(values.dtype)

    def field(values):
        return np.flip(values.transpose(order), mirrored).copy()

    shape = case.shape[list(order)]
    return dataclasses.replace(
        case,
        origin=np.where(sign < 0, -1.0, 1.0) * case.origin[list(order)]
        - np.where(sign < 0, CONFIG.spec.spacing * (shape - 1), 0.0),
        shape=shape,
        signed_distance=field(case.signed_distance),
        attached=field(case.attached),
        nodes=vectors(case.nodes),
        points=vectors(case.points),
        truth=vectors(case.truth),
        displacement=vectors(case.displacement),
        reference=vectors(case.reference),
        misfit=vectors(case.misfit),
    )


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 1, 0)])
@pytest.mark.parametrize("mirrored", [(), (1,), (0, 2)])
def test_turned_sample_is_the_sample_of_the_turned_organ(order, mirrored):
    case = made_up_case(4, CONFIG.spec)
    other = turned(case, order, mirrored)
    # The cells that carry the posterior are numbered anew.
    inside = (case.signed_distance <= np.float16(CONFIG.spec.spacing)).reshape(-1)
    numbered = np.full(inside.size, -1, dtype=np.int32)
    numbered[inside] = case.cell_tet
    moved = np.flip(numbered.reshape(case.shape).transpose(order), mirrored).reshape(-1)
    other = dataclasses.replace(other, cell_tet=moved[moved >= 0])
    expected = hybrid_sample(other, 1, CONFIG.spec)
    found = oriented(hybrid_sample(case, 1, CONFIG.spec), order, mirrored)
    for field in dataclasses.fields(found):
        ours, theirs = getattr(found, field.name), getattr(expected, field.name)
        torch.testing.assert_close(ours, theirs, atol=2e-5, rtol=1e-5)
    if mirrored or order != (0, 1, 2):
        assert not torch.equal(found.target, hybrid_sample(case, 1, CONFIG.spec).target)


def test_all_48_orientations_are_different():
    sample = hybrid_sample(made_up_case(4, CONFIG.spec, size=(0.06, 0.06, 0.06)), 0, CONFIG.spec)
    mirrors = [axes for count in range(4) for axes in itertools.combinations(range(3), count)]
    seen = {
        oriented(sample, order, axes).inputs.numpy().tobytes()
        for order in itertools.permutations(range(3))
        for axes in mirrors
    }
    assert len(seen) == 48


def test_records_come_back_rounded_to_micrometres():
    record = made_up_record(3, CONFIG.spec, cases=2)
    stored = parse_posteriors(format_posteriors(record), "here")
    assert (stored.settings, stored.seed, stored.simulation) == (record.settings, (1, 3), "hash 3")
    assert len(stored.cases) == 2
    for ours, theirs in zip(record.cases, stored.cases, strict=True):
        for field in dataclasses.fields(ours):
            before, after = getattr(ours, field.name), getattr(theirs, field.name)
            assert before.dtype == after.dtype, field.name
            np.testing.assert_allclose(after, before, atol=2.6e-6, rtol=0)


def test_half_a_record_is_refused():
    content = format_posteriors(made_up_record(3, CONFIG.spec))
    with pytest.raises(InvalidInputError, match="there must be a complete record of posteriors, got"):
        parse_posteriors(content[: len(content) // 2], "there")


def test_organs_are_held_out_by_number_with_all_their_cases(tmp_path):
    folder = write(tmp_path / "a", range(6), cases=2)
    dataset = PosteriorSet([folder], CONFIG, show_progress=False)
    assert (dataset.records, len(dataset.training), len(dataset.held_out)) == (6, 4 * 4, 2 * 4)
    few = PosteriorSet([folder], dataclasses.replace(CONFIG, validation_views=3), show_progress=False)
    assert [view.case.truth[0, 0] for view in few.held_out] == [
        dataset.held_out[index].case.truth[0, 0] for index in (0, 2, 5)
    ]
    both = PosteriorSet([folder, write(tmp_path / "b", range(3))], CONFIG, show_progress=False)
    assert both.records == 9 and both.digest() != dataset.digest()


def test_posteriors_that_do_not_fit_are_refused(tmp_path):
    folder = write(tmp_path / "a", range(2))
    with pytest.raises(InvalidInputError, match="on the grid of configuration hybrid .*--config hybrid"):
        PosteriorSet([folder], get_hybrid_config("hybrid"), show_progress=False)
    odd = made_up_record(7, CONFIG.spec)
    odd = dataclasses.replace(odd, settings=odd.settings | {"code": "another"})
    write_record(folder, record_name(7), format_posteriors(odd))
    with pytest.raises(InvalidInputError, match="one elastic estimator, got another code"):
        PosteriorSet([folder], CONFIG, show_progress=False)
    (tmp_path / "none").mkdir()
    with pytest.raises(InvalidInputError, match="at least 5 organs, got 0"):
        PosteriorSet([tmp_path / "none"], CONFIG, show_progress=False)


def test_batches_depend_on_their_place_alone(tmp_path):
    folder = tmp_path / "a"
    write(folder, range(3))
    write(folder, range(3, 6), size=(0.05, 0.10, 0.06))  # the same block on other axes
    dataset = PosteriorSet([folder], CONFIG, show_progress=False)

    def drawn(epoch, batch, count, threads):
        batches = HybridBatchSource(dataset, CONFIG, Ranks(), threads).drawn(epoch, batch)
        made = [next(batches) for _ in range(count)]
        batches.close()
        return made

    first = drawn(0, 0, 6, 1)
    assert [batch.next_place for batch in first] == [(0, 1), (0, 2), (0, 3), (1, 0), (1, 1), (1, 2)]
    assert sum(len(batch.inputs) for batch in first[:4]) == len(dataset.training)
    for one, other in zip(first[2:], drawn(0, 2, 4, 3), strict=True):
        assert torch.equal(one.inputs, other.inputs) and torch.equal(one.target, other.target)
    assert len({tuple(batch.inputs.shape[2:]) for batch in drawn(0, 0, 24, 1)}) > 1


def test_padded_points_are_neither_hidden_nor_visible():
    samples = [hybrid_sample(made_up_case(4, CONFIG.spec), view, CONFIG.spec) for view in (0, 1)]
    short = dataclasses.replace(
        samples[1],
        **{name: getattr(samples[1], name)[:70] for name in ("position", "target", "sigma", "visible")},
    )
    batch = collate([samples[0], short], 2)
    assert batch.target.shape == (2, 150, 3)
    assert (batch.hidden[0] + batch.visible[0]).sum() == 150
    assert (batch.hidden[1] + batch.visible[1]).tolist() == [1.0] * 70 + [0.0] * 80
    assert (batch.sigma[1, 70:] == 1.0).all()


def test_work_ahead_keeps_its_order_and_hands_on_errors():
    assert list(prefetched(lambda x: x * x, iter(range(10)), 3)) == [x * x for x in range(10)]
    results = prefetched(lambda x: 1 // x, iter([1, 0]), 2)
    assert next(results) == 1
    with pytest.raises(ZeroDivisionError):
        next(results)
