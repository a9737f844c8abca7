"""Places in a body at rest, and the values of its fields there: what does not depend on the mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpfem.errors import MeshError
from warpfem.mesh import Mesh
from warpfem.shapes import shape

ROUNDING = 1e-9
"""How far outside of a cell, in barycentric coordinates, a place on its boundary may come out."""

NEWTON_STEPS = 8
"""Iterations that find a place within a curved cell; in a straight one the first is exact."""

MOST_OUTSIDE = 0.5
"""How far outside of the nearest cell, in barycentric coordinates, a place may lie: meshes of different fineness round
a curved surface off differently."""


@dataclass(frozen=True, eq=False)
class Places:
    """Places in a mesh, as weights of the points of the cells that contain them.

    Attributes:
        cells: the points of the cell of each place, (k, a) int.
        weights: the values of their shape functions at the place, (k, a) float64.
    """

    cells: np.ndarray
    weights: np.ndarray

    def values(self, field: np.ndarray) -> np.ndarray:
        """The values (k, ...) of a field that is given at the points of the mesh (point_count, ...)."""
        return np.einsum("ka,ka...->k...", self.weights, field[self.cells])


def locate(mesh: Mesh, places: np.ndarray, extrapolate: bool = False) -> Places:
    """Finds the cells that contain places.

    Places outside of the mesh, up to half a cell's height, are extrapolated to from the nearest cell.

    Args:
        mesh: the mesh.
        places: rest positions (k, dim) [m].
        extrapolate: places that are farther outside are extrapolated to from the cell with the nearest centre.

    Raises:
        MeshError: a place is not in the mesh.
    """
    places = np.asarray(places, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] != mesh.dim or not np.isfinite(places).all():
        raise MeshError(f"places must be rows of {mesh.dim} finite numbers, not {places.tolist()!r}")
    corners = mesh.points[mesh.corners]
    inverse = np.linalg.inv((corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1))
    pad = MOST_OUTSIDE * np.ptp(corners, axis=1).max(axis=1, keepdims=True)
    lower, upper = corners.min(axis=1) - pad, corners.max(axis=1) + pad
    order = np.argsort(lower[:, 0])
    starts, widest = lower[order, 0], float((upper - lower)[:, 0].max())
    cells = np.empty(len(places), dtype=np.int64)
    coordinates = np.empty((len(places), mesh.dim + 1))
    for index, place in enumerate(places):
        first, last = np.searchsorted(starts, [place[0] - widest, place[0]], side="right")
        near = order[first:last]
        near = near[((lower[near] <= place) & (place <= upper[near])).all(axis=1)]
        barycentric = _barycentric(place, corners[near, 0], inverse[near])
        if not len(near) or barycentric.min(axis=1).max() < -MOST_OUTSIDE:
            if not extrapolate:
                raise MeshError(f"the place {place.tolist()} is not in the body")
            near = np.argmin(((corners.mean(axis=1) - place) ** 2).sum(axis=1), keepdims=True)
            barycentric = _barycentric(place, corners[near, 0], inverse[near])
        depth = barycentric.min(axis=1)
        # of the cells that share a place the one of the least number, whatever rounding says
        best = int(near[depth >= min(-ROUNDING, float(depth.max()))].min())
        cells[index], coordinates[index] = best, barycentric[near == best][0]
    own = shape(mesh.dim, mesh.order)
    if mesh.order == 2:
        coordinates = _curved(mesh, cells, coordinates, places)
    return Places(mesh.cells[cells], own.values(coordinates))


def _barycentric(place: np.ndarray, origins: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (c, dim + 1) of a place in cells with these first corners and inverted edges."""
    inner = np.einsum("cij,cj->ci", inverse, place - origins)
    return np.concatenate([1.0 - inner.sum(axis=1, keepdims=True), inner], axis=1)


def _curved(mesh: Mesh, cells: np.ndarray, coordinates: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (k, dim + 1) in quadratic cells, by Newton's method from those of the corners."""
    own, points = mesh.shape, mesh.points[mesh.cells[cells]]
    for _ in range(NEWTON_STEPS):
        missed = places - np.einsum("ka,kai->ki", own.values(coordinates), points)
        jacobians = np.einsum("kai,kad->kid", points, own.gradients(coordinates))
        step = np.linalg.solve(jacobians, missed[:, :, None])[:, :, 0]
        coordinates = coordinates + np.concatenate([-step.sum(axis=1, keepdims=True), step], axis=1)
    return coordinates


def spread_places(mesh: Mesh, count: int) -> np.ndarray:
    """Places spread evenly through a body, each standing for the same volume.

    Cells are taken in the order of their numbers, and the place within each is drawn uniformly, from a fixed seed: what
    is the same in all meshes is the mean over the places, to 1 / sqrt(count) of the field's variation.

    Args:
        mesh: the mesh.
        count: number of places.

    Returns:
        Rest positions (count, dim) [m].
    """
    ends = np.cumsum(mesh.cell_volumes)
    cells = np.searchsorted(ends, ends[-1] * (np.arange(count) + 0.5) / count)
    shares = np.random.default_rng(0).exponential(size=(count, mesh.dim + 1))
    shares /= shares.sum(axis=1, keepdims=True)
    return np.einsum("ka,kai->ki", shares, mesh.points[mesh.corners[cells]])
