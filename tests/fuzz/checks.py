"""What the node publishes, looked at."""

from typing import Any

import numpy as np

from fuzz.kind import expect


def check_distances(told: Any) -> None:
    """Raise FailedError unless distances from a tool are of each structure, and numbers or none at all."""
    count = len(told.names)
    sizes = [len(told.kinds), len(told.distance), len(told.sigma), len(told.nearest), len(told.ahead)]
    sizes += [len(told.ahead_sigma), len(told.covariance) // 9]
    expect(sizes == [count] * len(sizes), "not a distance of each structure")
    numbers = [*told.distance, *told.sigma, *told.ahead, *told.covariance]
    numbers += [value for point in told.nearest for value in (point.x, point.y, point.z)]
    expect(not np.isinf(numbers).any(), "distances without bounds")


def columns_of(cloud: Any) -> Any:
    """Return a dense cloud's fields as a structured array."""
    kinds = {7: "<f4", 2: "u1", 6: "<u4"}
    names, formats, offsets = zip(*((f.name, kinds[f.datatype], f.offset) for f in cloud.fields), strict=True)
    layout = {"names": names, "formats": formats, "offsets": offsets, "itemsize": cloud.point_step}
    return np.frombuffer(bytes(cloud.data), dtype=np.dtype(layout))
