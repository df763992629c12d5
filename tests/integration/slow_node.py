"""The node with one more estimator, `slow`: it answers with the mean displacement after a time the test chooses.

Its time is spent in Python, as a callback's would be, so that signals arrive in the middle of it.
"""

import os
import time

import numpy as np

from softtissue_estimator.estimators.estimator import Estimate, Estimator, register_estimator, silent
from softtissue_estimator.ros.node import main

ESTIMATE_S = float(os.environ.get("SLOW_ESTIMATE_S", "1.0"))
LOAD_S = float(os.environ.get("SLOW_LOAD_S", "0.0"))


def busy(seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.001)


class MeanEstimate(Estimate):
    def __init__(self, organ, mean):
        self._mean = mean
        self.displacement = np.tile(mean, (len(organ.query_points), 1))
        self.sigma = None
        self.stages = {"mean": 0.0}

    def displacement_at(self, points):
        return np.tile(self._mean, (len(points), 1)), None


class SlowEstimator(Estimator):
    name = "slow"
    device = "cpu"

    def __init__(self, config):
        pass

    def load_organ(self, organ, progress=silent):
        progress("slow to load")
        busy(LOAD_S)
        self._organ = organ
        self._estimates = 0

    def estimate(self, observation):
        self._estimates += 1
        if self._estimates > 1:  # the first is the node's own, to warm up
            busy(ESTIMATE_S)
        return MeanEstimate(self._organ, observation.displacement.mean(axis=0))


register_estimator("slow", SlowEstimator)

if __name__ == "__main__":
    main()
