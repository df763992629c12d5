"""What a segment is, from the words and colours with which files describe it."""

import re

import numpy as np

from softtissue_estimator.segmentation.segments import Colour

VESSEL, TUMOUR, OTHER = "vessel", "tumour", "other"
_TUMOUR_WORDS = re.compile(
    r"tumou?r|lesion|neoplas|metasta|carcinoma|adenoma|sarcoma|cancer|malignan|nodule|\bhcc\b|\bcyst|"
    r"morphologically altered",
    re.IGNORECASE,
)
_VESSEL_WORDS = re.compile(
    r"vessel|vein|\bvena|venous|arter|aort|vascula|\bportal|blood|caval?\b|\bivc\b", re.IGNORECASE
)
_COLOURS: dict[str, Colour] = {
    VESSEL: (0.25, 0.35, 0.85),
    TUMOUR: (0.95, 0.85, 0.2),
    OTHER: (0.8, 0.8, 0.8),
}
# To linear sRGB (IEC 61966-2-1). The white point is D65, with which those who write DICOM SEG convert sRGB.
_WHITE = np.array([0.95047, 1.0, 1.08883])
_XYZ_TO_RGB = np.array(
    [
        [3.2406, -1.5372, -0.4986],
        [-0.9689, 1.8758, 0.0415],
        [0.0557, -0.2040, 1.0570],
    ]
)


def guess_kind(name: str, meaning: str) -> str:
    """Guess the kind of a structure from its name and what its terminology says; the name counts first.

    Examples
    --------
    >>> guess_kind("Segment_3", "Tissue Portal vein"), guess_kind("Tumor 2", ""), guess_kind("gallbladder", "")
    ('vessel', 'tumour', 'other')
    """
    for words in (name.replace("_", " "), meaning):
        if _TUMOUR_WORDS.search(words):
            return TUMOUR
        if _VESSEL_WORDS.search(words):
            return VESSEL
    return OTHER


def colour_of(kind: str) -> Colour:
    """Colour of a structure whose file tells none."""
    return _COLOURS.get(kind, _COLOURS[OTHER])


def meaning_of_tags(tags: str) -> str:
    """Return the words of the terminology entry in the tags of a segment as 3D Slicer writes them; else nothing.

    Examples
    --------
    >>> meaning_of_tags("Segmentation.Status:done|TerminologyEntry:list~SCT^1^Tissue~SCT^2^Portal vein~^^|")
    'Tissue Portal vein'
    """
    for tag in tags.split("|"):
        key, _, entry = tag.strip().partition(":")
        if key == "TerminologyEntry":
            codes = [code.split("^") for code in entry.split("~")]
            return " ".join(code[2].strip() for code in codes if len(code) == 3 and code[2].strip())
    return ""


def colour_of_numbers(text: str) -> Colour | None:
    """Read three numbers from 0 to 1; None where they are not.

    Examples
    --------
    >>> colour_of_numbers("0.5 1 0")
    (0.5, 1.0, 0.0)
    """
    try:
        red, green, blue = (float(part) for part in text.split())
    except ValueError:
        return None
    return (red, green, blue) if all(0.0 <= part <= 1.0 for part in (red, green, blue)) else None


def colour_of_cielab(values: tuple[int, int, int]) -> Colour:
    """Convert a Recommended Display CIELab Value of DICOM (PS3.3, C.10.7.1.1; 0 to 65535 each) to sRGB, 0 to 1.

    Examples
    --------
    >>> [round(part, 2) for part in colour_of_cielab((65535, 32896, 32896))]
    [1.0, 1.0, 1.0]
    """
    scaled = np.asarray(values, dtype=np.float64) / 65535.0
    lightness, a, b = 100.0 * scaled[0], 255.0 * scaled[1] - 128.0, 255.0 * scaled[2] - 128.0
    middle = (lightness + 16.0) / 116.0
    root = np.array([middle + a / 500.0, middle, middle - b / 200.0])
    xyz = np.where(root > 6.0 / 29.0, root**3, 3.0 * (6.0 / 29.0) ** 2 * (root - 4.0 / 29.0)) * _WHITE
    linear = np.clip(_XYZ_TO_RGB @ xyz, 0.0, 1.0)
    red, green, blue = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1.0 / 2.4) - 0.055
    )
    return float(red), float(green), float(blue)
