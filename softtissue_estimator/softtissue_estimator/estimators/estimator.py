"""What every estimator offers; the only part of the core that a node has to know."""

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.diagnosis import Diagnosis
from softtissue_estimator.observation.bare_cloud import BareCloud
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.organ.mesh import BoolArray
from softtissue_estimator.organ.organ import Organ

FloatArray = NDArray[np.float64]
Progress = Callable[[str], None]
Factory = Callable[[EstimatorConfig], "Estimator"]


def silent(message: str) -> None:
    """Progress callback that says nothing."""


class Estimate(ABC):
    """Answer to one observation. Positions and displacements are in the organ's frame, in metres.

    Attributes
    ----------
    displacement : (q, 3) float64
        Intraoperative minus preoperative position of `Organ.query_points`, m.
    sigma : (q,) float64 or None
        Predicted standard deviation of each component of `displacement`, m; None if the estimator gives none.
    stages : dict
        Seconds that each stage took, in order.
    diagnosis : Diagnosis
        What it says about the observation.
    seen : (c, 3) float64 or None
        Places on the preoperative surface that the observation shows, m, those alone that belong to the organ; None
        where the estimator does not find that out.
    """

    displacement: FloatArray
    sigma: FloatArray | None
    stages: dict[str, float]
    diagnosis: Diagnosis = Diagnosis()
    seen: FloatArray | None = None

    @abstractmethod
    def displacement_at(self, points: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Displacement of any preoperative points.

        Parameters
        ----------
        points : (k, 3) float64
            Preoperative positions, m, organ frame.

        Returns
        -------
        displacement : (k, 3) float64, m
        sigma : (k,) float64, m, or None
        """

    def relied_on(self) -> BoolArray | None:
        """Which points of the observation, or of the cloud, the answer relies on, (n,); None where it is on all.

        The others were found not to be of the organ.
        """
        return None

    def covariance_at(self, points: FloatArray) -> FloatArray | None:
        """Covariance of where any preoperative points are now, seen with the registration and its error.

        Here displacement and error are taken for independent, and the displacement's components too.

        Parameters
        ----------
        points : (k, 3) float64
            Preoperative positions, m, organ frame.

        Returns
        -------
        (k, 3, 3) float64, m^2, organ's axes, or None if the estimator gives no standard deviations
        """
        displacement, sigma = self.displacement_at(points)
        if sigma is None:
            return None
        found = np.square(sigma)[:, None, None] * np.eye(3)
        if self.diagnosis.registration is not None:
            found = found + self.diagnosis.registration.covariance_of(points + displacement)
        return np.asarray(found)


class Estimator(ABC):
    """Estimates where the inside of an organ is from an observation of its surface.

    Attributes
    ----------
    name : str
        As in the parameter `estimator`.
    device : str
        Where it computes, for example 'cpu' or 'cuda:0'.
    """

    name: str
    device: str

    @abstractmethod
    def load_organ(self, organ: Organ, progress: Progress = silent) -> None:
        """Prepare for an organ: seconds the first time, less afterwards because slow results are cached.

        Parameters
        ----------
        organ : Organ
        progress : callable
            Told in a sentence what is going on, whenever something slow begins.

        Raises
        ------
        SoftTissueError
            If the organ cannot be used; the organ loaded before stays in use.
        """

    def precompute(self, organ: Organ, progress: Progress = silent) -> Any:
        """Compute what is slow in `load_organ`, which another process may do; loads nothing.

        Parameters
        ----------
        organ, progress
            As of `load_organ`.

        Returns
        -------
        object
            For `take_over`: arrays, tensors and plain objects, which pickle. None where all is done in `take_over`.

        Raises
        ------
        SoftTissueError
            If the organ cannot be used.
        """
        return None

    def take_over(self, organ: Organ, computed: Any, progress: Progress = silent) -> None:
        """Prepare for an organ with what `precompute` made of it; else as `load_organ`."""
        self.load_organ(organ, progress)

    @abstractmethod
    def estimate(self, observation: Observation) -> Estimate:
        """Answer one observation.

        Raises
        ------
        InvalidInputError
            If no organ is loaded or the observation cannot be used.
        """

    def estimate_bare(self, cloud: BareCloud) -> Estimate:
        """Answer a cloud without correspondences.

        Raises
        ------
        InvalidInputError
            As `estimate`; of most estimators always, as they need correspondences.
        """
        raise InvalidInputError(
            f"estimator {self.name}: expected a cloud with correspondences, got one without, which 'elastic' answers"
        )

    def compliances(self, points: FloatArray, directions: FloatArray) -> tuple[NDArray[np.float32], ...]:
        """How far unit loads move the surface of the loaded organ, as the estimator believes before any observation.

        Parameters
        ----------
        points : (k, 3) float64
            On the preoperative surface, m, organ frame.
        directions : (k, 3) float64
            Unit vectors: along them.

        Returns
        -------
        tuple of (k, p) float32
            For each of p loads, of which only the ratios mean something; one array for each supposition about what
            holds the organ, none if the estimator has no elastic model.
        """
        return ()

    def forget(self) -> None:  # noqa: B027 (most estimators remember nothing)
        """Forget earlier observations, where an estimator answers each about the one before."""

    def forget_registration(self) -> None:  # noqa: B027
        """Forget what was found out about the registration: observations from now on come with another one."""

    def close(self) -> None:  # noqa: B027
        """End what runs in the background; nothing may be asked afterwards."""


def _elastic(config: EstimatorConfig) -> Estimator:
    return _construct("elastic.estimator", "ElasticEstimator", config)


def _paper(config: EstimatorConfig) -> Estimator:
    return _construct("paper.estimator", "PaperEstimator", config)


def _construct(module: str, name: str, config: EstimatorConfig) -> Estimator:
    # Imported only when asked for: the elastic estimator must not wait for networks.
    factory: Factory = getattr(importlib.import_module(f"softtissue_estimator.estimators.{module}"), name)
    return factory(config)


_factories: dict[str, Factory] = {"elastic": _elastic, "paper": _paper}


def register_estimator(name: str, factory: Factory) -> None:
    """Make `create_estimator` know another estimator.

    Raises
    ------
    InvalidInputError
        If the name is taken.
    """
    if name in _factories:
        raise InvalidInputError(f"estimator name: expected one that is not in use, got {name!r}")
    _factories[name] = factory


def estimator_names() -> tuple[str, ...]:
    """Return the names that `create_estimator` knows, sorted."""
    return tuple(sorted(_factories))


def check_estimator(name: str) -> None:
    """Look whether an estimator has that name.

    Raises
    ------
    InvalidInputError
        If none has.
    """
    if name not in _factories:
        raise InvalidInputError(
            f"parameter estimator: expected one of {', '.join(estimator_names())}, got {name!r}"
        )


def create_estimator(config: EstimatorConfig) -> Estimator:
    """Make the estimator that `config.estimator` names.

    Raises
    ------
    InvalidInputError
        If no estimator has that name.
    SoftTissueError
        If the estimator cannot start, for example because its weights are damaged.
    """
    check_estimator(config.estimator)
    return _factories[config.estimator](config)
