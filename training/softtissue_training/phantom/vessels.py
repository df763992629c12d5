"""Vessel trees that fill an organ, as tubes of smoothly changing radius.

Centrelines grow as a minimum spanning tree that also keeps the way to the root short (Cuntz et al. 2010, *One rule
to grow them all*) through random points of the organ; radii follow Murray's law: the cube of a branch's radius is
the sum of the cubes of its children's.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.farthest_points import farthest_points
from softtissue_training.phantom.implicit import Implicit, Points, Values, capsule, smooth_union

Array = NDArray[np.float64]
# Of the way to the root against the length of the new branch; 0 gives a wandering tree.
_ROOT_WAY_WEIGHT = 0.45
_BLEND_M = 0.0015  # rounding where tubes meet


@dataclass(frozen=True)
class VesselTree:
    """Centreline nodes; call it with points ``(n, 3)`` in metres, negative inside the vessel.

    `parent` of a node comes before the node; the root's is -1.
    """

    nodes: Array  # (n, 3) m
    parent: NDArray[np.int64]  # (n,)
    radius: Array  # (n,) m

    def __call__(self, points: Points) -> Values:
        """Return roughly the signed distance (m) of points ``(n, 3)`` (m), positive outside."""
        value = np.full(len(points), np.inf)
        for child in range(1, len(self.nodes)):
            start, end = self.nodes[self.parent[child]], self.nodes[child]
            reach = max(self.radius[self.parent[child]], self.radius[child]) + 0.01
            near = np.all(
                (points > np.minimum(start, end) - reach) & (points < np.maximum(start, end) + reach), axis=1
            )
            tube = capsule(points[near], start, end, self.radius[self.parent[child]], self.radius[child])
            value[near] = smooth_union(np.minimum(value[near], 1.0), tube, _BLEND_M)
        # Far from every tube only the sign matters.
        return np.asarray(np.minimum(value, 0.01))

    @property
    def box(self) -> tuple[Array, Array]:
        """Lower and upper corner (m) of a box with room around the vessel."""
        room = self.radius.max() + 0.006
        return self.nodes.min(axis=0) - room, self.nodes.max(axis=0) + room


def grow_tree(
    organ: Implicit,
    root: Array,
    terminals: int,
    candidates: Array,
    terminal_radius: float,
) -> VesselTree:
    """Grow a vessel from `root` to `terminals` ends spread evenly over the `candidates`.

    Parameters
    ----------
    organ : negative inside
    root : (3,) m, where the vessel enters
    terminals : number of ends
    candidates : (k, 3) m, points through which the vessel may pass
    terminal_radius : m, radius of the ends

    Raises
    ------
    InvalidInputError
        If there are fewer candidates than ends, or the root lies outside the organ.
    """
    if len(candidates) < terminals:
        raise InvalidInputError(
            f"expected at least {terminals} points to grow through, got {len(candidates)}"
        )
    if float(organ(root[None])[0]) >= 0.0:
        raise InvalidInputError(f"expected a root inside the organ, got {root} m outside it")
    points = np.concatenate([root[None], candidates])
    parent = _balanced_tree(points)
    ends = spread(points, terminals, first=0)
    kept = _ancestors(parent, ends)
    nodes, parent = _renumber(points, parent, kept)
    nodes = _straighten(nodes, parent)
    return VesselTree(nodes, parent, _murray(parent, terminal_radius))


def interior_points(
    organ: Implicit,
    box: tuple[Array, Array],
    depth: float,
    count: int,
    rng: np.random.Generator,
    free: Callable[[Points], NDArray[np.bool_]] | None = None,
) -> Array:
    """Draw `count` points ``(count, 3)`` m at least `depth` (m) below the organ's surface, and where `free`."""
    found: list[Array] = []
    missing = count
    for _ in range(200):
        drawn = rng.uniform(box[0], box[1], (4 * count, 3))
        drawn = drawn[organ(drawn) < -depth]
        if free is not None:
            drawn = drawn[free(drawn)]
        found.append(drawn[:missing])
        missing -= len(found[-1])
        if missing == 0:
            return np.concatenate(found)
    raise InvalidInputError(
        f"expected room for {count} points {depth} m below the surface, found {count - missing}"
    )


def spread(points: Array, count: int, first: int) -> NDArray[np.int64]:
    """Pick `count` points far from one another and from point `first`, which is not among them."""
    return farthest_points(points, count + 1, first)[0][1:]


def _balanced_tree(points: Array) -> NDArray[np.int64]:
    """Parents ``(n,)`` of the spanning tree from point 0 with the least length plus weighted way to the root."""
    count = len(points)
    parent = np.zeros(count, dtype=np.int64)
    parent[0] = -1
    way = np.zeros(count)
    joined = np.zeros(count, dtype=bool)
    joined[0] = True
    length = np.linalg.norm(points - points[0], axis=1)
    # Squared lengths make two short steps cheaper than a long one, so that branches share their way.
    cost = length**2 / 0.01 + _ROOT_WAY_WEIGHT * length
    for _ in range(count - 1):
        new = int(np.argmin(np.where(joined, np.inf, cost)))
        joined[new] = True
        way[new] = way[parent[new]] + np.linalg.norm(points[new] - points[parent[new]])
        length = np.linalg.norm(points - points[new], axis=1)
        offer = length**2 / 0.01 + _ROOT_WAY_WEIGHT * (way[new] + length)
        better = ~joined & (offer < cost)
        parent[better] = new
        cost[better] = offer[better]
    return parent


def _ancestors(parent: NDArray[np.int64], ends: NDArray[np.int64]) -> NDArray[np.int64]:
    kept = {0}
    for end in ends:
        node = int(end)
        while node not in kept:
            kept.add(node)
            node = int(parent[node])
    return np.array(sorted(kept))


def _renumber(
    points: Array, parent: NDArray[np.int64], kept: NDArray[np.int64]
) -> tuple[Array, NDArray[np.int64]]:
    """Keep some nodes and number them so that parents come first (breadth first)."""
    children: dict[int, list[int]] = {int(node): [] for node in kept}
    for node in kept[1:]:
        children[int(parent[node])].append(int(node))
    order = [0]
    for node in order:
        order.extend(children[node])
    number = {node: index for index, node in enumerate(order)}
    renumbered = np.array([-1] + [number[int(parent[node])] for node in order[1:]])
    return points[order], renumbered


def _straighten(nodes: Array, parent: NDArray[np.int64], rounds: int = 4) -> Array:
    """Pull every inner node half way towards the mean of its neighbours; root and ends stay."""
    count = len(nodes)
    ends = np.bincount(parent[1:], minlength=count) == 0
    for _ in range(rounds):
        total = np.zeros_like(nodes)
        number = np.zeros(count)
        for child in range(1, count):
            for a, b in ((child, parent[child]), (parent[child], child)):
                total[a] += nodes[b]
                number[a] += 1.0
        moved = 0.5 * nodes + 0.5 * total / number[:, None]
        moved[0], moved[ends] = nodes[0], nodes[ends]
        nodes = moved
    return nodes


def _murray(parent: NDArray[np.int64], terminal_radius: float) -> Array:
    """Radii ``(n,)`` m by Murray's law from equal ends."""
    cubes = np.zeros(len(parent))
    for node in range(len(parent) - 1, -1, -1):
        if cubes[node] == 0.0:
            cubes[node] = terminal_radius**3
        if node > 0:
            cubes[parent[node]] += cubes[node]
    return np.cbrt(cubes)
