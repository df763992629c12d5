"""What a cloud is: pairs with the preoperative surface, tracks or bare points; told by its fields and its company."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from sensor_msgs.msg import PointCloud2

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.cloud_layout import field_names
from softtissue_estimator.ros.inputs.conversions import carries_reference, check_cloud
from softtissue_estimator.ros.inputs.point_labels import TRACK

GRACE_S = 0.3
"""After a publisher of clouds is there, one of their correspondences may still be found."""


class Kind(Enum):
    """Kinds of clouds, as `EstimatorStatus.matching` names them."""

    PAIRS = "pairs"
    TRACKS = "tracks"
    BARE = "bare"


@dataclass(frozen=True)
class Company:
    """Publishers that are announced: of clouds, and of correspondences."""

    clouds: Callable[[], int]
    correspondences: Callable[[], int]


class Kinds:
    """Tells clouds apart. All methods run in the executor's thread.

    Parameters
    ----------
    matching : callable
        Returns `EstimatorConfig.matching`.
    company : Company
    clock : callable
        Returns monotonic seconds.
    """

    def __init__(self, matching: Callable[[], str], company: Company, clock: Callable[[], float]) -> None:
        self._matching, self._company, self._clock = matching, company, clock
        self._alone_since_s: float | None = None

    def look(self) -> None:
        """See who is there; to be called several times a second."""
        if self._company.correspondences() or not self._company.clouds():
            self._alone_since_s = None
        elif self._alone_since_s is None:
            self._alone_since_s = self._clock()

    def of(self, cloud: PointCloud2) -> Kind | None:
        """Tell what a cloud is; None where its correspondences may come on their own topic.

        Raises
        ------
        InvalidInputError
            If the cloud cannot be read, or is not what `matching` wants.
        """
        matching = self._matching()
        reference = matching in ("auto", "given") and carries_reference(cloud)
        check_cloud(cloud, reference)
        if matching == "closest":
            return Kind.BARE
        if matching == "tracks":
            if TRACK not in field_names(cloud):
                fields = " ".join(field_names(cloud))
                raise InvalidInputError(
                    f"cloud: expected a field {TRACK} (matching: tracks), got fields {fields}"
                )
            return Kind.TRACKS
        if reference:
            return Kind.PAIRS
        if matching == "given" or not self._alone():
            return None
        return by_fields(cloud)

    def after_waiting(self, cloud: PointCloud2) -> Kind | None:
        """Tell what a cloud is whose correspondences did not come; None where it must not go without them."""
        if self._matching() != "auto" or self._company.correspondences():
            return None
        return by_fields(cloud)

    def _alone(self) -> bool:
        """Whether nobody publishes correspondences, and that for longer than publishers take to find each other."""
        if self._company.correspondences():
            self._alone_since_s = None
            return False
        now = self._clock()
        if self._alone_since_s is None:
            self._alone_since_s = now
        return now - self._alone_since_s >= GRACE_S


def by_fields(cloud: PointCloud2) -> Kind:
    """Tell what a cloud without correspondences is."""
    return Kind.TRACKS if TRACK in field_names(cloud) else Kind.BARE
