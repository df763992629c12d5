"""What lies inside the organ, what was cut out of it and what is beside it."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.segmentation.drawn import GRIDS, NAMES, masks
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.segmentation.enclosure import enclose
from softtissue_estimator.segmentation.segments import Segment, make_segmentation, masks_of_labels
from softtissue_estimator.segmentation.terminology import guess_kind

WHERE = GRIDS["anisotropic"]


def segmentation_of(drawn):
    segments = []
    for name, mask in drawn.items():
        ((cut, start),) = masks_of_labels(mask.astype(np.uint8)).values()
        segments.append(Segment(name, cut, start))
    affine = WHERE.affine.copy()
    affine[:3] *= 1e-3
    return make_segmentation(segments, affine)


def enclosed(drawn):
    found, said = segmentation_of(drawn), []
    organ, *others = found.segments
    result = enclose(found, organ, others, lambda s: guess_kind(s.name, s.meaning), said.append)
    return result, "\n".join(said)


def names(segments):
    return tuple(segment.name for segment in segments)


def test_overlapping_segments_leave_the_organ_as_it_is():
    drawn = masks(WHERE)
    result, said = enclosed(drawn)
    assert (names(result.inside), names(result.outside), said) == (NAMES[1:3], NAMES[3:], "")
    assert result.organ.count == drawn["liver"].sum()


def test_what_was_cut_out_of_the_organ_is_its_inside_again():
    drawn, whole = masks(WHERE, exclusive=True), masks(WHERE)["liver"]
    result, said = enclosed(drawn)
    assert (names(result.inside), names(result.outside)) == (NAMES[1:3], NAMES[3:])
    assert "portal vein: was cut out of liver, which encloses it again" in said
    assert "liver: 10.1 ml are filled" in said  # of the tumour, a cavity, and of the vein
    mask = result.organ.window((0, 0, 0), WHERE.shape)
    assert (mask ^ whole).sum() < 0.002 * whole.sum()
    outside = drawn["portal vein"] & ~whole
    assert outside.sum() > 20 and (mask & outside).sum() < 0.25 * outside.sum()  # the vein leaves the organ


def test_cavity_is_filled_and_said():
    drawn = masks(WHERE)
    drawn["liver"] = drawn["liver"] & ~drawn["tumor 1"]
    cavity = drawn.pop("tumor 1").sum()
    result, said = enclosed(drawn)
    assert f"liver: {1e-3 * cavity * WHERE.voxel_volume:.3g} ml are filled" in said
    assert result.organ.count == masks(WHERE)["liver"].sum()


def test_small_second_body_is_left_out_and_a_large_one_refused():
    drawn = masks(WHERE)
    whole = drawn["liver"].sum()
    drawn["liver"][2:6, 2:6, 2:6] = True
    result, said = enclosed(drawn)
    assert "bodies beside the largest are left out: 1, 0.48 ml together" in said
    assert result.organ.count == whole
    drawn["liver"] |= drawn["spleen"]
    drawn["liver"][:, 95:105] = False
    with pytest.raises(InvalidInputError, match=r"expected one body, got a second of 57.8 ml beside"):
        enclosed(drawn)


def test_window_reaches_beyond_the_grid():
    segment = Segment("a", np.ones((2, 2, 2), bool), (1, 0, 3))
    window = segment.window((0, -1, 4), (3, 2, 6))
    assert window.sum() == 4 and window[1:3, 1:3, 0].all()
    assert not replace(segment, start=(9, 9, 9)).window((0, 0, 0), (3, 3, 3)).any()
