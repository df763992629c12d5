"""Real-time soft-tissue navigation: where the inside of an organ is now, from an observation of its surface.

The names in `__all__` are the public interface; no ROS is needed for any of them. Each loads its module when it is
first used: importing the package alone loads neither PyTorch nor NumPy.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softtissue_estimator.config import EstimatorConfig
    from softtissue_estimator.errors import (
        CheckpointError,
        InvalidInputError,
        MeshError,
        MissingDependencyError,
        OrganError,
        OrganNotFoundError,
        SoftTissueError,
    )
    from softtissue_estimator.estimators.estimator import (
        Estimate,
        Estimator,
        create_estimator,
        estimator_names,
        register_estimator,
    )
    from softtissue_estimator.observation.observation import Observation, make_observation
    from softtissue_estimator.organ.mesh import SurfaceMesh
    from softtissue_estimator.organ.mesh_io import StoredMesh, read_mesh
    from softtissue_estimator.organ.organ import Organ, Structure, load_organ, make_organ
    from softtissue_estimator.support.resources import bundled_organ
    from softtissue_estimator.view.estimate_picture import draw_estimate

__all__ = [
    "CheckpointError",
    "Estimate",
    "Estimator",
    "EstimatorConfig",
    "InvalidInputError",
    "MeshError",
    "MissingDependencyError",
    "Observation",
    "Organ",
    "OrganError",
    "OrganNotFoundError",
    "SoftTissueError",
    "StoredMesh",
    "Structure",
    "SurfaceMesh",
    "bundled_organ",
    "create_estimator",
    "draw_estimate",
    "estimator_names",
    "load_organ",
    "make_observation",
    "make_organ",
    "read_mesh",
    "register_estimator",
]

# The imports above, for when a name is used. A test holds the three lists together.
_NAMES_OF_MODULES = {
    "config": ("EstimatorConfig",),
    "errors": (
        "CheckpointError",
        "InvalidInputError",
        "MeshError",
        "MissingDependencyError",
        "OrganError",
        "OrganNotFoundError",
        "SoftTissueError",
    ),
    "estimators.estimator": (
        "Estimate",
        "Estimator",
        "create_estimator",
        "estimator_names",
        "register_estimator",
    ),
    "observation.observation": ("Observation", "make_observation"),
    "organ.mesh": ("SurfaceMesh",),
    "organ.mesh_io": ("StoredMesh", "read_mesh"),
    "organ.organ": ("Organ", "Structure", "load_organ", "make_organ"),
    "support.resources": ("bundled_organ",),
    "view.estimate_picture": ("draw_estimate",),
}
_MODULE_OF_NAME = {name: module for module, names in _NAMES_OF_MODULES.items() for name in names}

if not TYPE_CHECKING:  # type checkers see the imports above and complain about any other name

    def __getattr__(name: str) -> Any:
        """Import a public name when it is first used."""
        if name not in _MODULE_OF_NAME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"{__name__}.{_MODULE_OF_NAME[name]}"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """List the public names, imported or not, and what every module has."""
    return sorted({*globals(), *__all__})
