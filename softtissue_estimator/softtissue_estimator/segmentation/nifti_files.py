"""Read label maps in NIfTI files."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_estimator.segmentation.segments import (
    Colour,
    Segment,
    Segmentation,
    check_count,
    make_segmentation,
    masks_of_labels,
)

NIFTI_FORMATS = (".nii", ".nii.gz")
_UNITS_M = {"mm": 1e-3, "meter": 1.0, "micron": 1e-6, "unknown": 1e-3}
# A table of labels in an extension of the header, as Connectome Workbench and TotalSegmentator write it.
_LABEL = re.compile(r"<Label\b([^>]*)>\s*(?:<!\[CDATA\[(.*?)\]\]>|([^<]*))\s*</Label>", re.DOTALL)
_ATTRIBUTE = re.compile(r"(\w+)\s*=\s*[\"']([^\"']*)[\"']")
_MOST_DIFFERENCE_M = 1e-3  # between the two ways in which a header says where its voxels are


def read_nifti(path: Path) -> Segmentation:
    """Read a label map; segments are called by their numbers where the header has no table of labels.

    The sform of the header counts, or the qform where there is none.

    Raises
    ------
    InvalidInputError
        If its header does not say where its voxels are in the patient, or its voxels are no labels.
    """
    import nibabel  # an extra

    image: Any = nibabel.load(str(path))
    shape = tuple(int(length) for length in image.shape)
    check_count(shape)
    if len(shape) < 3 or any(length != 1 for length in shape[3:]):
        raise InvalidInputError(f"expected a label map with three axes, got shape {shape}")
    affine = _grid(image)
    found = masks_of_labels(np.asanyarray(image.dataobj).reshape(shape[:3]))
    names = _label_table(image.header)
    segments = []
    for number in sorted(found):
        name, colour = names.get(number, (str(number), None))
        segments.append(Segment(name, *found[number], colour))
    return make_segmentation(segments, affine)


def _grid(image: Any) -> FloatArray:
    """Return the way from indices to LPS in metres; NIfTI's own axes are right, anterior, superior."""
    header = image.header
    if not (int(header["sform_code"]) or int(header["qform_code"])):
        raise InvalidInputError(
            "expected a header that says where the voxels are in the patient (sform or qform), got one without"
        )
    unit = header.get_xyzt_units()[0]
    if unit not in _UNITS_M:
        raise InvalidInputError(f"expected lengths in mm, m or micrometres, the header says {unit}")
    affine: FloatArray = np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.asarray(image.affine, dtype=np.float64)
    affine[:3] *= _UNITS_M[unit]
    if int(header["sform_code"]) and int(header["qform_code"]):
        other = _UNITS_M[unit] * np.asarray(header.get_qform(), dtype=np.float64)[:3]
        ends = np.array([[0, 0, 0, 1], [*image.shape[:3], 1]], dtype=np.float64)
        apart = np.abs(ends @ (affine[:3] * np.array([[-1.0], [-1.0], [1.0]]) - other).T).max()
        if not apart <= _MOST_DIFFERENCE_M:
            raise InvalidInputError(
                f"expected one place of the voxels, the header's sform and qform are {1e3 * apart:.3g} mm apart; "
                "remove the wrong one"
            )
    return affine


def _label_table(header: Any) -> dict[int, tuple[str, Colour | None]]:
    """Read names and colours of labels from extensions of the header, where there are any."""
    table: dict[int, tuple[str, Colour | None]] = {}
    for extension in getattr(header, "extensions", ()):
        content = extension.get_content()
        text = content if isinstance(content, str) else bytes(content).decode("utf-8", errors="replace")
        for attributes, quoted, plain in _LABEL.findall(text):
            fields = dict(_ATTRIBUTE.findall(attributes))
            name = (quoted or plain).strip()
            if name and fields.get("Key", "").isdigit():
                table[int(fields["Key"])] = (name, _colour(fields))
    return table


def _colour(fields: dict[str, str]) -> Colour | None:
    try:
        red, green, blue = (float(fields[name]) for name in ("Red", "Green", "Blue"))
    except (KeyError, ValueError):
        return None
    return (red, green, blue) if all(0.0 <= part <= 1.0 for part in (red, green, blue)) else None
