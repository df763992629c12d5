"""Let an estimator answer a stream, frame after frame, as the node runs it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.estimator import Estimate, create_estimator, estimator_names
from softtissue_estimator.observation.bare_cloud import make_bare_cloud
from softtissue_estimator.observation.observation import Observation, make_observation
from softtissue_estimator.organ.organ import Organ
from softtissue_training.evaluation.case import EvaluationCase
from softtissue_training.evaluation.methods import Method, MethodSpec
from softtissue_training.evaluation.streams.conditions import Clouds
from softtissue_training.evaluation.streams.frames import (
    Frame,
    StreamAnswers,
    checked,
    gathered,
    reason,
    timed,
)
from softtissue_training.evaluation.streams.pace import Pace
from softtissue_training.evaluation.streams.recording import AnyStream

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

PATIENCE_S = 3600.0
"""Of trackers: figures must not depend on how busy the machine is."""
MEMORYLESS_STRIDE = 10
"""Estimators without a history answer every so many frames."""
IMPROVES_BETWEEN_FRAMES = ("elastic",)
"""Kinds with a thread that is at work between frames, which get the time that it has in use."""


@dataclass(eq=False)
class StreamMethod:
    """An estimator that is shown streams.

    Parameters
    ----------
    spec
        Which one.
    paced
        Wait until the next frame is due (`Pace`); None for estimators that improve their state meanwhile.
    stride
        Every how many frames an estimator without a history is asked.
    """

    spec: MethodSpec
    paced: bool | None = None
    stride: int = MEMORYLESS_STRIDE
    _loaded: str = field(default="", init=False)

    def __post_init__(self) -> None:
        self._memoryless: Method | None = None
        if not has_history(self.spec):
            self._memoryless = self.spec.make()
        else:
            config = EstimatorConfig(
                estimator=self.spec.kind,
                checkpoint=str(self.spec.checkpoint or ""),
                device=self.spec.device,
                tracking=True,
                tracking_patience_s=PATIENCE_S,
            )
            self._estimator = create_estimator(config)
        if self.paced is None:
            self.paced = is_paced(self.spec)

    def answer(self, stream: AnyStream, clouds: Clouds) -> StreamAnswers:
        """Show all clouds in order; whatever goes wrong inside the estimator counts as refused."""
        organ = stream.organ
        if not np.array_equal(clouds.attached, organ.attached):
            organ = organ.with_attached(clouds.attached)
        stride = 1 if self._memoryless is None else self.stride
        index = np.arange(0, len(clouds.frames), stride)
        try:
            self._begin(organ)
        except Exception as error:
            return _gathered(stream, clouds, index, [Frame(failure=reason(error)) for _ in index])
        frames: list[Frame] = []
        pace = Pace(stream.interval_s)
        for number in index:
            if self.paced:
                pace.wait()
            frames.append(self._frame(stream, organ, clouds, int(number)))
        return _gathered(stream, clouds, index, frames)

    def close(self) -> None:
        """End what the estimator has running."""
        if self._memoryless is None:
            self._estimator.close()

    def _begin(self, organ: Organ) -> None:
        if self._memoryless is not None:
            self._memoryless.load(organ)
        elif organ.digest == self._loaded:
            self._estimator.forget()
        else:
            self._loaded = ""
            self._estimator.load_organ(organ)
            self._loaded = organ.digest

    def _frame(self, stream: AnyStream, organ: Organ, clouds: Clouds, number: int) -> Frame:
        seen = clouds.seen[number]
        try:
            if clouds.bare:
                return self._bare(stream, organ, clouds, number)
            observation, _ = make_observation(
                clouds.points[number][seen],
                clouds.said(number)[seen],
                stream.told_noise_m,
                organ,
                EstimatorConfig(),
            )
            # Clouds arrive at the rate of the stream, whatever happened between two of them.
            observation = replace(observation, stamp_s=float(stream.times[number]))
            if self._memoryless is None:
                return self._estimated(lambda: self._estimator.estimate(observation), stream.inner)
            case = _case(stream, organ, observation, int(clouds.frames[number]))
            reading = self._memoryless.answer(case)
            return checked(Frame(reading.displacement, reading.sigma, reading.seconds))
        except Exception as error:
            return Frame(failure=reason(error))

    def _bare(self, stream: AnyStream, organ: Organ, clouds: Clouds, number: int) -> Frame:
        """Show a cloud without correspondences."""
        if self._memoryless is not None:
            raise InvalidInputError("expected an estimator that answers clouds without correspondences")
        points = clouds.points[number][clouds.seen[number]]
        cloud, _ = make_bare_cloud(points, stream.told_noise_m, EstimatorConfig())
        covariance = None
        if clouds.registration_sigma is not None:
            covariance = np.diag(np.square(np.repeat(clouds.registration_sigma, 3)))
        cloud = replace(cloud, stamp_s=float(stream.times[number]), registration_covariance=covariance)
        return self._estimated(lambda: self._estimator.estimate_bare(cloud), stream.inner)

    def _estimated(self, estimate_it: Callable[[], Estimate], points: FloatArray) -> Frame:
        estimate, seconds, processor_s = timed(estimate_it)
        displacement, sigma = estimate.displacement_at(points)
        return checked(Frame(displacement, sigma, seconds, int(bool(estimate.diagnosis.doubts)), processor_s))


def has_history(spec: MethodSpec) -> bool:
    """Whether an estimator is one of the product, which is shown every frame."""
    return spec.kind in estimator_names()


def is_paced(spec: MethodSpec) -> bool:
    """Whether frames wait until they are due, where nothing else is asked for."""
    return spec.kind in IMPROVES_BETWEEN_FRAMES


def _case(stream: AnyStream, organ: Organ, observation: Observation, frame: int) -> EvaluationCase:
    return EvaluationCase(
        name=stream.name,
        organ=organ,
        observation=observation,
        points=stream.inner,
        truth=stream.truth[frame],
        visible=np.zeros(len(stream.inner), dtype=bool),
        depth=stream.depth,
        volume=stream.volume,
    )


def _gathered(
    stream: AnyStream, clouds: Clouds, index: NDArray[np.int64], frames: list[Frame]
) -> StreamAnswers:
    return gathered(frames, stream.truth[clouds.frames[index]], index, clouds.event)
