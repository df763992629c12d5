"""Voxels of files that others wrote are where they were drawn, whichever way the axes of the grid point."""

import numpy as np
import pytest

from estimator.segmentation.drawn import (
    CENTRE,
    GRIDS,
    NAMES,
    Grid,
    labels,
    mask_of,
    masks,
    places_of,
)
from estimator.segmentation.files import (
    TYPES,
    write_highdicom,
    write_itk,
    write_nibabel,
    write_slicerio,
)
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.segmentation.reading import read_segmentation
from softtissue_estimator.segmentation.terminology import guess_kind

nrrd = pytest.importorskip("nrrd", reason="pynrrd, of the extra `import`, is not installed")
pytest.importorskip("nibabel", reason="nibabel, of the extra `import`, is not installed")
pydicom = pytest.importorskip("pydicom", reason="pydicom, of the extra `import`, is not installed")
EVERY_GRID = pytest.mark.parametrize("where", GRIDS.values(), ids=GRIDS)


def check(path, drawn, where: Grid, names=None):
    """Each segment has exactly the voxels that were drawn, in the patient's coordinates."""
    found = read_segmentation(path)
    assert [segment.name for segment in found.segments] == list(names or drawn)
    for segment, mask in zip(found.segments, drawn.values(), strict=True):
        np.testing.assert_array_equal(mask_of(segment, found.affine, where), mask)
    assert found.voxel_volume == pytest.approx(1e-9 * where.voxel_volume, rel=1e-5)
    return found


@EVERY_GRID
@pytest.mark.parametrize("exclusive", [True, False])
def test_slicer_segmentation(tmp_path, where, exclusive):
    drawn = masks(where, exclusive)
    shape = write_slicerio(tmp_path / "patient.seg.nrrd", drawn, where)
    assert len(shape) == (3 if exclusive else 4)
    found = check(tmp_path / "patient.seg.nrrd", drawn, where)
    for segment in found.segments:
        category, kind, colour = TYPES[segment.name]
        assert (segment.colour, segment.meaning) == (colour, f"{category} {kind}")
    kinds = [guess_kind("Segment_1", segment.meaning) for segment in found.segments]
    assert kinds == ["other", "vessel", "tumour", "other"]


@EVERY_GRID
@pytest.mark.parametrize("name", ["labels.nrrd", "labels.nii.gz", "labels.nii"])
def test_label_map_of_itk(tmp_path, where, name):
    write_itk(tmp_path / name, labels(where), where)
    check(tmp_path / name, masks(where, exclusive=True), where, names="1234")


@EVERY_GRID
@pytest.mark.parametrize("forms", [{}, {"sform": 0, "qform": 1}, {"sform": 2, "qform": 1}, {"unit": "meter"}])
def test_label_map_of_nibabel(tmp_path, where, forms):
    write_nibabel(tmp_path / "labels.nii.gz", labels(where), where, **forms)
    check(tmp_path / "labels.nii.gz", masks(where, exclusive=True), where, names="1234")


@EVERY_GRID
@pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL", "LABELMAP"])
def test_dicom_segmentation(tmp_path, where, kind):
    drawn = masks(where, exclusive=True)
    write_highdicom(tmp_path / "seg.dcm", drawn, where, kind)
    found = check(tmp_path / "seg.dcm", drawn, where)
    for segment in found.segments:
        np.testing.assert_allclose(segment.colour, TYPES[segment.name][2], atol=0.02)
    assert guess_kind("x", found.segments[1].meaning) == "vessel"


def shifted(path, move):
    """Move each frame of a DICOM SEG along by what a function says of its position, LPS mm."""
    data = pydicom.dcmread(path)
    for group in data.PerFrameFunctionalGroupsSequence:
        place = group.PlanePositionSequence[0]
        moved = move(np.array([float(value) for value in place.ImagePositionPatient]))
        place.ImagePositionPatient = [f"{value:.6f}" for value in moved]
    data.save_as(path)


def test_tilted_gantry_is_followed(tmp_path):
    """Each slice is shifted against the one below along y, by a third of their distance."""
    where = GRIDS["anisotropic"]
    drawn = masks(where, exclusive=True)
    write_highdicom(tmp_path / "a.dcm", drawn, where)
    low = where.affine[2, 3]
    shifted(tmp_path / "a.dcm", lambda place: place + np.array([0.0, (place[2] - low) / 3.0, 0.0]))
    tilted = where.affine.copy()
    tilted[1, 2] += tilted[2, 2] / 3.0
    check(tmp_path / "a.dcm", drawn, Grid(where.shape, tilted))


@pytest.mark.parametrize(
    "move",
    [
        lambda place: place + np.array([0.0, 0.0, 0.4 * (place[2] > CENTRE[2])]),  # a gap
        lambda place: place + np.array([5.0 * (place[2] > CENTRE[2]), 0.0, 0.0]),  # the patient moved
    ],
)
def test_frames_that_are_on_no_regular_grid_are_refused(tmp_path, move):
    where = GRIDS["anisotropic"]
    write_highdicom(tmp_path / "a.dcm", masks(where, exclusive=True), where)
    shifted(tmp_path / "a.dcm", move)
    with pytest.raises(InvalidInputError, match="expected frames above each other at even distances"):
        read_segmentation(tmp_path / "a.dcm")


def test_header_as_slicer_writes_it_by_hand(tmp_path):
    """RAS and LAS spaces, a list as last axis, a segment without a voxel, fields in any order."""
    data = np.zeros((4, 5, 6, 2), dtype=np.uint8)
    data[1, 2, 3, 0], data[2, 2, 2, 1] = 7, 1
    header = {
        "space": "right-anterior-superior",
        "kinds": ["domain", "domain", "domain", "list"],
        "space directions": np.vstack([np.diag([1.0, 2.0, 3.0]), [np.nan] * 3]),
        "space origin": [10.0, 20.0, 30.0],
        "Segment1_Name": "b",
        "Segment1_Layer": "1",
        "Segment1_LabelValue": "1",
        "Segment0_ID": "Segment_9",
        "Segment0_LabelValue": "7",
        "Segment0_Layer": "0",
        "Segment0_Color": "nothing",
        "Segment2_Name": "nobody",
        "Segment2_LabelValue": "3",
    }
    path = tmp_path / "a.seg.nrrd"
    for space, signs in (("right-anterior-superior", [-1, -1, 1]), ("LAS", [1, -1, 1]), ("LPS", [1, 1, 1])):
        nrrd.write(str(path), data, header | {"space": space})
        found = read_segmentation(path)
        assert [segment.name for segment in found.segments] == ["Segment_9", "b"]
        assert found.empty == ("nobody",) and found.segments[0].colour is None
        first, second = (places_of(segment, found.affine)[0] for segment in found.segments)
        np.testing.assert_allclose(first, np.array(signs) * [11.0, 24.0, 39.0])
        np.testing.assert_allclose(second, np.array(signs) * [12.0, 24.0, 36.0])


def test_table_of_labels_in_a_nifti_header_gives_names_and_colours(tmp_path):
    import nibabel

    where = GRIDS["anisotropic"]
    image = write_nibabel(tmp_path / "a.nii.gz", labels(where), where)
    table = "".join(
        f'<Label Key="{n}" Red="0.1" Green="0.2" Blue="0.3" Alpha="1"><![CDATA[{name}]]></Label>'
        for n, name in enumerate(NAMES, 1)
    )
    xml = f"<CaretExtension><VolumeInformation><LabelTable>{table}</LabelTable></VolumeInformation></CaretExtension>"
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, xml.encode()))
    nibabel.save(image, tmp_path / "a.nii.gz")
    found = read_segmentation(tmp_path / "a.nii.gz")
    assert [segment.name for segment in found.segments] == list(NAMES)
    assert found.segments[0].colour == (0.1, 0.2, 0.3)


def small_nrrd(path, data=None, **changes):
    header = {
        "space": "left-posterior-superior",
        "space directions": np.eye(3),
        "space origin": [0.0, 0.0, 0.0],
    } | {key.replace("_", " "): value for key, value in changes.items()}
    header = {key: value for key, value in header.items() if value is not None}
    nrrd.write(str(path), np.ones((3, 3, 3), np.uint8) if data is None else data, header)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"space": "scanner-xyz"},
            "expected a space such as left-posterior-superior in the header, got scanner",
        ),
        ({"space": "posterior-left-superior"}, "expected axes in the order of left-posterior-superior"),
        ({"space_directions": np.ones((3, 3))}, "expected three axes that span the space"),
        ({"space_units": ["cm", "cm", "cm"]}, "expected space units of mm, got"),
        ({"data": np.full((3, 3, 3), -1024, np.int16)}, "is it the scan itself"),
        ({"data": np.full((3, 3, 3), 0.5)}, "expected a label map of whole numbers"),
        ({"data": np.zeros((3, 3, 3), np.uint8)}, "expected segments, got none with a voxel"),
    ],
)
def test_nrrd_that_cannot_be_meant_gives_a_sentence(tmp_path, changes, words):
    small_nrrd(tmp_path / "a.nrrd", **changes)
    with pytest.raises(InvalidInputError, match=words):
        read_segmentation(tmp_path / "a.nrrd")


def test_nifti_that_says_nothing_or_two_things_of_its_place_is_refused(tmp_path):
    import nibabel

    where, path = GRIDS["anisotropic"], tmp_path / "a.nii"
    write_nibabel(path, labels(where), where, sform=0, qform=0)
    with pytest.raises(InvalidInputError, match="expected a header that says where the voxels are"):
        read_segmentation(path)
    image = write_nibabel(path, labels(where), where, sform=1, qform=1)
    other = image.affine.copy()
    other[0, 3] += 5.0
    image.set_qform(other, code=1)
    nibabel.save(image, path)
    with pytest.raises(InvalidInputError, match="sform and qform are 5 mm apart"):
        read_segmentation(path)
    nibabel.save(nibabel.Nifti1Image(np.zeros((3, 3, 3, 2), np.uint8), np.eye(4)), path)
    with pytest.raises(InvalidInputError, match=r"three axes, got shape \(3, 3, 3, 2\)"):
        read_segmentation(path)


def test_dicom_file_of_another_kind_is_refused(tmp_path):
    path = tmp_path / "a.dcm"
    write_highdicom(path, masks(GRIDS["anisotropic"], exclusive=True), GRIDS["anisotropic"])
    data = pydicom.dcmread(path)
    data.SOPClassUID = pydicom.uid.CTImageStorage
    data.save_as(tmp_path / "ct.dcm")
    with pytest.raises(InvalidInputError, match="expected a DICOM SEG, got CT Image Storage"):
        read_segmentation(tmp_path / "ct.dcm")


def test_damaged_files_give_a_sentence_each_and_nothing_else(tmp_path, capfd):
    where = GRIDS["anisotropic"]
    files = [tmp_path / name for name in ("a.seg.nrrd", "a.nii", "a.nii.gz", "a.dcm")]
    write_slicerio(files[0], masks(where), where)
    write_nibabel(files[1], labels(where), where)
    write_nibabel(files[2], labels(where), where)
    write_highdicom(files[3], masks(where, exclusive=True), where)
    capfd.readouterr()
    random = np.random.default_rng(0)
    said = []
    for path in files:
        content = path.read_bytes()
        for _ in range(25):
            damaged = bytearray(content[: random.integers(len(content))])
            for place in random.integers(0, min(len(damaged), 2000), 3) if damaged else ():
                damaged[place] ^= 1 << random.integers(8)
            path.write_bytes(damaged)
            try:
                read_segmentation(path)
            except InvalidInputError as error:
                said.append(str(error))
    assert len(said) > 80
    assert [words for words in said if not words.startswith("segmentation ") or "\n" in words] == []
    assert capfd.readouterr() == ("", "")


def test_what_is_no_segmentation_is_said(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "web.seg.nrrd").write_text("<!DOCTYPE html>")
    for name, words in (
        ("notes.txt", "got a file of another kind"),
        ("web.seg.nrrd", "cannot be read as its name says"),
        ("none.nii", "expected a file, found none"),
        (".", "expected a file, found a folder"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            read_segmentation(tmp_path / name)
