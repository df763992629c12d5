"""Posteriors made up from formulae, for tests that need no elasticity."""

import numpy as np
import torch

from softtissue_estimator.estimators.hybrid.input import HybridSpec, posterior_cells
from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.organ.volume_mesh import VolumeMesh, clean_tets
from softtissue_training.learning.hybrid.posterior_record import PosteriorCase, PosteriorRecord

SETTINGS = {"version": 1, "recipe": {}, "elastic": {}, "code": "formulae"}


def block_mesh(lower, upper, cells):
    """Block cut into tetrahedra, six a cell."""
    axes = [np.linspace(a, b, n + 1) for a, b, n in zip(lower, upper, cells, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape([n + 1 for n in cells])
    corner = np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij"), axis=-1).reshape(-1, 3)
    tets = []
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        at = corner.copy()
        path = [number[tuple(at.T)]]
        for axis in order:
            at[:, axis] += 1
            path.append(number[tuple(at.T)])
        tets.append(np.stack(path, axis=1))
    return clean_tets(nodes, np.concatenate(tets))


def made_up_case(seed: int, spec: HybridSpec, views: int = 2, size=(0.10, 0.06, 0.05)) -> PosteriorCase:
    """A block whose posteriors are smooth random fields, and whose truth is off by a part of the misfit's mean."""
    rng = np.random.default_rng(seed)
    half = 0.5 * np.array(size)
    mesh: VolumeMesh = block_mesh(-half, half, (5, 3, 3))
    grid = VoxelGrid.covering(
        -half, half, spec.spacing, multiple=spec.architecture.multiple, margin_cells=spec.margin_cells
    )
    outside = np.abs(grid.points()) - half
    distance = np.where(
        outside.max(axis=1) > 0, np.linalg.norm(np.maximum(outside, 0), axis=1), outside.max(axis=1)
    )
    distance = distance.reshape(grid.shape).astype(np.float16)
    cells = grid.points()[posterior_cells(torch.from_numpy(distance).float(), grid.spacing).numpy()]
    points = rng.uniform(-half, half, size=(150, 3)).astype(np.float32)
    drawn = [_view(rng, mesh, half) for _ in range(views)]
    mean = mesh.interpolation(points.astype(np.float64)) @ drawn[0]["displacement"]
    truth = mean + np.array([0.002, -0.001, 0.0015]) * (1.0 + points[:, :1] / half[0])
    return PosteriorCase(
        origin=np.array(grid.origin),
        shape=np.array(grid.shape),
        signed_distance=distance,
        attached=(grid.points()[:, 0] < -0.3 * size[0]).reshape(grid.shape),
        nodes=mesh.nodes.astype(np.float32),
        tets=mesh.tets.astype(np.int32),
        cell_tet=mesh.locate(cells).astype(np.int32),
        points=points,
        truth=truth.astype(np.float32),
        point_tet=mesh.locate(points.astype(np.float64)).astype(np.int32),
        displacement=np.stack([view["displacement"] for view in drawn]).astype(np.float32),
        sigma=np.stack([view["sigma"] for view in drawn]).astype(np.float16),
        visible=rng.random((views, len(points))) < 0.3,
        share=rng.uniform(0.1, 0.5, views).astype(np.float32),
        noise=np.zeros(views, dtype=np.float32),
        counts=np.array([len(view["reference"]) for view in drawn]),
        reference=np.concatenate([view["reference"] for view in drawn]).astype(np.float32),
        misfit=np.concatenate([view["misfit"] for view in drawn]).astype(np.float16),
        seen_sigma=np.concatenate([view["seen_sigma"] for view in drawn]).astype(np.float16),
    )


def _view(rng, mesh, half):
    count = int(rng.integers(20, 40))
    reference = rng.uniform(-half, half, size=(count, 3))
    reference[:, 2] = half[2]
    linear = rng.normal(size=(3, 3)) * 0.05
    return {
        "displacement": mesh.nodes @ linear.T + 0.002,
        "sigma": 0.001 + 0.002 * np.abs(mesh.nodes[:, 2] - half[2]) / half[2],
        "reference": reference,
        "misfit": rng.normal(size=(count, 3)) * 5e-4,
        "seen_sigma": rng.uniform(0.0007, 0.003, count),
    }


def made_up_record(number: int, spec: HybridSpec, cases: int = 1, **options) -> PosteriorRecord:
    """A record of made-up cases."""
    settings = SETTINGS | {
        "grid": {
            "spacing": spec.spacing,
            "margin_cells": spec.margin_cells,
            "multiple": spec.architecture.multiple,
        }
    }
    made = tuple(made_up_case(100 * number + case, spec, **options) for case in range(cases))
    return PosteriorRecord(made, settings, (1, number), f"hash {number}", ())
