"""How the organ moves in the scene: it breathes, and an instrument pushes it.

Breathing is a force that the diaphragm spreads over the dome, on top of one that is always there: the first cloud
already shows a deformed organ. The attached patch stays where it is in the room.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from softtissue_training.phantom.anatomy import Anatomy
from softtissue_training.phantom.motion import Motion, follow, hold, push_force
from softtissue_training.scene.spec import Breathing, SceneSpec

Array = NDArray[np.float64]


def breath(breathing: Breathing, time: float) -> float:
    """How far the organ has breathed in at a time (s), 0 to 1; it rests longer breathed out (Lujan et al. 1999)."""
    return float(np.sin(np.pi * time / breathing.period) ** 4)


def push_phase(spec: SceneSpec, time: float) -> float:
    """Phase of the push, 0 to 1, at a time (s)."""
    return (time - spec.push_start) / (spec.duration - spec.push_start)


def simulate_scene(
    anatomy: Anatomy, spec: SceneSpec, progress: Callable[[str], None] = lambda _: None
) -> Motion:
    """Follow the organ's equilibria through the scene; the steady force comes on before it begins.

    Raises
    ------
    SolverDivergedError
        If an equilibrium is not found.
    MeshError
        If the organ cannot be filled with elements.
    """
    held = hold(anatomy, spec.phantom)
    pushed, breathed = held.shares(spec.push), held.shares(spec.breathing.push)
    times = np.linspace(-spec.run_up, spec.duration, spec.states)
    loads = []
    for time in times:
        # Linear is smooth enough: nothing is seen before time 0.
        coming = min(1.0, 1.0 + time / spec.run_up)
        size = spec.breathing.steady_n + spec.breathing.push.peak_n * breath(spec.breathing, time) * (
            time > 0.0
        )
        direction = np.array(spec.breathing.push.direction) / np.linalg.norm(spec.breathing.push.direction)
        force = push_force(spec.push, push_phase(spec, time))
        loads.append(pushed[:, None] * force + breathed[:, None] * (coming * size * direction))
    return follow(held, times, loads, progress)
