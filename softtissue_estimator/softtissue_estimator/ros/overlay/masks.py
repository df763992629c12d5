"""Where instruments are on the images, as a segmentation says. May be asked from any thread."""

import threading
from collections import OrderedDict

from sensor_msgs.msg import Image

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.images import Picture, Pixels, read_mask
from softtissue_estimator.support.newest import keep_newest

_KEPT = 8  # a segmentation is late by a few images


class Masks:
    """Keeps the newest masks of instruments."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._masks: OrderedDict[int, Pixels] = OrderedDict()

    def take(self, message: Image) -> None:
        """Take a mask: not 0 where there is an instrument.

        Raises
        ------
        InvalidInputError
            If it is none (`read_mask`).
        """
        stamp_ns, marked = read_mask(message)
        with self._lock:
            keep_newest(self._masks, _KEPT, stamp_ns, marked)

    def of(self, picture: Picture, maximum_age_s: float) -> Pixels | None:
        """Return the mask of an image: that of the nearest stamp, (rows, columns); None if nobody sends any.

        Raises
        ------
        InvalidInputError
            If it is further away in time than `maximum_age_s`, or of another size.
        """
        with self._lock:
            if not self._masks:
                return None
            nearest = min(self._masks, key=lambda stamp_ns: abs(stamp_ns - picture.stamp_ns))
            mask = self._masks[nearest]
        age_s = 1e-9 * abs(nearest - picture.stamp_ns)
        if age_s > maximum_age_s:
            raise InvalidInputError(
                f"mask: expected one within {maximum_age_s:g} s of the image (maximum_mask_age_s), got one"
                f" {age_s:.2f} s away"
            )
        if mask.shape != picture.pixels.shape[:2]:
            (rows, columns), (wanted_rows, wanted_columns, _) = mask.shape, picture.pixels.shape
            raise InvalidInputError(
                f"mask: expected {wanted_columns} x {wanted_rows} pixels as the image has, got {columns} x {rows}"
            )
        return mask
