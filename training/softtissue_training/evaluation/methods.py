"""The estimators that are compared: simple ones, and whatever the product ships, through its public interface.

`register_method` adds further ones. What `create_estimator` knows needs no registration.
"""

from __future__ import annotations

import hashlib
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

import softtissue_training
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.estimator import Estimator, create_estimator, estimator_names
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.observation.rigid import fit_rigid
from softtissue_estimator.organ.mesh import sum_by_index
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.organ.surface_lookup import SurfaceLookup
from softtissue_training.core_sources import core_sources
from softtissue_training.evaluation.case import EvaluationCase

FloatArray = NDArray[np.float64]

_SAME_PLACE_M = 1e-5
_COMMON_SOURCES = (
    "evaluation/case.py",
    "evaluation/observe.py",
    "evaluation/methods.py",
    "organs/surface_patch.py",
)


@dataclass(frozen=True, eq=False)
class Reading:
    """Displacement (n, 3) m and standard deviation (n,) m or None at a case's points, and seconds it took."""

    displacement: FloatArray
    sigma: FloatArray | None
    seconds: float


class Method(ABC):
    """An estimator under evaluation."""

    @abstractmethod
    def load(self, organ: Organ) -> None:
        """Prepare for an organ; timed as setup."""

    @abstractmethod
    def answer(self, case: EvaluationCase) -> Reading:
        """Answer a case whose organ is loaded."""


class Simple(Method):
    """An estimator that is a function of the case."""

    def __init__(self, displacement: Callable[[EvaluationCase], FloatArray]) -> None:
        self._displacement = displacement

    def load(self, organ: Organ) -> None:
        """Do nothing: there is nothing to prepare."""

    def answer(self, case: EvaluationCase) -> Reading:
        """See `Method.answer`."""
        start = time.perf_counter()
        displacement = self._displacement(case)
        return Reading(displacement, None, time.perf_counter() - start)


class Product(Method):
    """An estimator of the product, exactly as the node runs it.

    The time is that of `Estimator.estimate`, which includes the answer at the organ's surface; reading the estimate
    at the case's points is not counted.
    """

    def __init__(self, name: str, checkpoint: Path | None, device: str) -> None:
        config = EstimatorConfig(estimator=name, checkpoint=str(checkpoint or ""), device=device)
        self._estimator: Estimator = create_estimator(config)

    def load(self, organ: Organ) -> None:
        """See `Method.load`."""
        self._estimator.load_organ(organ)

    def answer(self, case: EvaluationCase) -> Reading:
        """See `Method.answer`."""
        start = time.perf_counter()
        estimate = self._estimator.estimate(case.observation)
        seconds = time.perf_counter() - start
        displacement, sigma = estimate.displacement_at(case.points)
        return Reading(displacement, sigma, seconds)


def no_displacement(case: EvaluationCase) -> FloatArray:
    """Estimate that nothing moved, (n, 3) m; its error is the displacement itself."""
    return np.zeros_like(case.points)


def rigid_displacement(case: EvaluationCase) -> FloatArray:
    """Move all points by the rigid motion that fits the observed ones best, (n, 3) m."""
    observation = case.observation
    motion = fit_rigid(
        observation.reference, observation.reference + observation.displacement, observation.sigma**-2.0
    )
    return motion.apply(case.points) - case.points


def interpolated_displacement(case: EvaluationCase) -> FloatArray:
    """Interpolate by radial basis functions between what is observed and the attached vertices, which rest, (n, 3) m.

    The kernel is -r with an affine part: the biharmonic spline, in three dimensions the interpolant of least bending.
    Observed points are averaged over patches of 5 mm first, because the work grows with their cube.
    """
    points, displacement = average_by_patch(case.observation, case.organ.surface_lookup)
    held = case.organ.surface.vertices[case.organ.attached]
    # Two values in one place have no interpolant.
    held = held[cKDTree(points).query(held, distance_upper_bound=_SAME_PLACE_M)[0] > _SAME_PLACE_M]
    values = np.concatenate([displacement, np.zeros_like(held)])
    spline = RBFInterpolator(np.concatenate([points, held]), values, kernel="linear", degree=1)
    return np.asarray(spline(case.points), dtype=np.float64)


def average_by_patch(observation: Observation, lookup: SurfaceLookup) -> tuple[FloatArray, FloatArray]:
    """Average the observed points of each patch of about 5 mm, (c, 3) m before and (c, 3) m displacement."""
    patch = lookup.patch[lookup.nearest_sample(observation.reference)]
    count = len(lookup.patch_areas)
    number = np.bincount(patch, minlength=count)
    values = np.concatenate([observation.reference, observation.displacement], axis=1)
    sums = sum_by_index(patch, values, count)
    means = sums[number > 0] / number[number > 0][:, None]
    return means[:, :3], means[:, 3:]


def _finite_elements(case: EvaluationCase) -> FloatArray:
    # Gmsh and the solver are slow to import.
    from softtissue_training.evaluation.prescribed import finite_element_displacement

    return finite_element_displacement(case)


_FUNCTIONS: dict[str, Callable[[EvaluationCase], FloatArray]] = {
    "zero": no_displacement,
    "rigid": rigid_displacement,
    "rbf": interpolated_displacement,
    "fem": _finite_elements,
}
SIMPLE = tuple(_FUNCTIONS)


def register_method(name: str, displacement: Callable[[EvaluationCase], FloatArray]) -> None:
    """Make `parse_methods` know another simple estimator.

    Raises
    ------
    InvalidInputError
        If the name is taken.
    """
    if name in _FUNCTIONS:
        raise InvalidInputError(f"estimator name: expected one that is not in use, got {name!r}")
    _FUNCTIONS[name] = displacement


@dataclass(frozen=True)
class MethodSpec:
    """Which estimator to make.

    Attributes
    ----------
    label
        Its name in tables.
    kind
        A simple estimator's name, or one that `create_estimator` knows.
    checkpoint
        Its weights; None for those that come with the product.
    device
        As `EstimatorConfig.device`.
    """

    label: str
    kind: str
    checkpoint: Path | None = None
    device: str = "auto"

    def make(self) -> Method:
        """Make the estimator.

        Raises
        ------
        SoftTissueError
            There is no such estimator, or its weights cannot be read.
        """
        if self.kind in _FUNCTIONS:
            return Simple(_FUNCTIONS[self.kind])
        if self.kind not in estimator_names():
            raise InvalidInputError(
                f"estimators: expected {', '.join([*_FUNCTIONS, *estimator_names()])}, got {self.kind!r}"
            )
        return Product(self.kind, self.checkpoint, self.device)

    def key(self) -> str:
        """Return a hash of all that its answers depend on: the kind, the weights and the code."""
        content = hashlib.sha256(f"{self.kind}\0{self.device}".encode())
        if self.checkpoint is not None:
            content.update(self.checkpoint.read_bytes())
        for path in _sources(self.kind):
            content.update(path.read_bytes())
        return content.hexdigest()[:16]

    def provenance(self) -> dict[str, Any]:
        """Return the file of weights, its hash and what it says about how it came about; nothing without a file."""
        if self.checkpoint is None:
            return {}
        # Torch is slow to import.
        from softtissue_estimator.estimators.paper.checkpoint import read_provenance

        return {
            "file": self.checkpoint.name,
            "sha256": hashlib.sha256(self.checkpoint.read_bytes()).hexdigest(),
            "provenance": read_provenance(self.checkpoint),
        }


def parse_methods(listed: str, device: str = "auto") -> list[MethodSpec]:
    """Read a list of estimators such as `zero,elastic,paper=FILE`.

    Labels are the kinds; where one kind is listed more than once, with the name of its file.

    Raises
    ------
    InvalidInputError
        The list is empty, names an estimator twice or a file that does not exist.
    """
    entries = [entry.strip().partition("=") for entry in listed.split(",") if entry.strip()]
    if not entries:
        raise InvalidInputError(f"estimators: expected a list such as zero,rigid,elastic, got {listed!r}")
    kinds = [kind for kind, _, _ in entries]
    specs: list[MethodSpec] = []
    for kind, equals, file in entries:
        if equals and kind in _FUNCTIONS:
            raise InvalidInputError(f"estimators: {kind} takes no file, got {kind}={file}")
        if equals and not Path(file).is_file():
            raise InvalidInputError(f"estimators: expected a file of weights for {kind}, got {file!r}")
        label = f"{kind}:{Path(file).stem}" if file and kinds.count(kind) > 1 else kind
        specs.append(MethodSpec(label, kind, Path(file) if file else None, device))
    labels = [spec.label for spec in specs]
    if len(set(labels)) < len(labels):
        raise InvalidInputError(f"estimators: expected each once, got {', '.join(labels)}")
    return specs


def relabelled(specs: Sequence[MethodSpec], labels: Sequence[str]) -> list[MethodSpec]:
    """Give estimators other names in tables, as by `elastic=elastic@0.1`.

    Raises
    ------
    InvalidInputError
        An estimator is not there, or two would have the same name.
    """
    names = {spec.label: spec.label for spec in specs}
    for text in labels:
        old, equals, new = text.partition("=")
        if old not in names or not equals or not new:
            raise InvalidInputError(
                f"--label: expected one of {', '.join(names)}, =, and a name, got {text!r}"
            )
        names[old] = new
    if len(set(names.values())) < len(names):
        raise InvalidInputError(f"--label: expected different names, got {', '.join(names.values())}")
    return [replace(spec, label=names[spec.label]) for spec in specs]


def _sources(kind: str) -> list[Path]:
    """List the files whose change makes stored answers of a kind of estimator worthless."""
    training = Path(softtissue_training.__file__).parent
    files = [training / name for name in _COMMON_SOURCES]
    if kind == "fem":
        files += [training / "evaluation" / "prescribed.py", *sorted((training / "physics").glob("*.py"))]
    if kind not in _FUNCTIONS:
        files += core_sources()
    return files
