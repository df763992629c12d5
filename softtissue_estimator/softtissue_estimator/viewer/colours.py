"""Colours of structures: their own, or that of their standard deviation."""

import numpy as np

from softtissue_estimator.view.structures import FloatArray, Structures

Rgb = tuple[int, int, int]

ORGAN: Rgb = (196, 130, 120)
OBSERVED: Rgb = (110, 220, 150)
LEFT_OUT: Rgb = (235, 60, 50)
UNKNOWN: Rgb = (150, 150, 150)
"""Of a structure without a standard deviation."""
# From sure to unsure. Lightness falls from end to end, so that the order is seen without telling colours apart.
_SCALE = np.array([[253, 231, 120], [245, 170, 60], [225, 90, 50], [150, 30, 70]], dtype=np.float64)


def sigma_colour(sigma_m: float, scale_m: float) -> Rgb:
    """Return the colour of a standard deviation.

    Parameters
    ----------
    sigma_m : float
        m; NaN where none is known.
    scale_m : float
        From here on the last colour of the scale, m.

    Examples
    --------
    >>> sigma_colour(0.0, 0.005)
    (253, 231, 120)
    >>> sigma_colour(0.02, 0.005)
    (150, 30, 70)
    """
    if np.isnan(sigma_m):
        return UNKNOWN
    place = min(max(sigma_m / scale_m, 0.0), 1.0) * (len(_SCALE) - 1)
    number = min(int(place), len(_SCALE) - 2)
    mixed = _SCALE[number] + (place - number) * (_SCALE[number + 1] - _SCALE[number])
    return _rgb(mixed)


def colours(structures: Structures, sigma: FloatArray | None, scale_m: float) -> list[Rgb]:
    """Return a colour for each structure: its own, or with `sigma` (s,) m that of its standard deviation."""
    if sigma is None:
        return [_rgb(255.0 * colour) for colour in structures.colours]
    return [sigma_colour(float(one), scale_m) for one in sigma]


def css(colour: Rgb) -> str:
    """Return a colour as a style sheet has it."""
    return f"rgb({colour[0]},{colour[1]},{colour[2]})"


def _rgb(colour: FloatArray) -> Rgb:
    red, green, blue = (round(float(part)) for part in colour)
    return red, green, blue
