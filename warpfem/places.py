"""Places in a body at rest, and the values of its fields there: what does not depend on the mesh."""

from __future__ import annotations

from collections.abc import Iterator
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

MOST_BOXES = 64
"""Boxes of the grid per cell, on average, in which places are looked for."""

MOST_NUMBERED = 2.0**62
"""Boxes that the grid may have, empty ones with the others, so that each has a number."""

PAIRS_AT_ONCE = 1 << 18
"""Places and cells whose distances are computed at a time: 50 MB."""


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
    cells = np.full(len(places), mesh.cell_count, dtype=np.int64)
    for place, cell in _near(corners.min(axis=1) - pad, corners.max(axis=1) + pad, places):
        depth = _barycentric(places[place], corners[cell, 0], inverse[cell]).min(axis=1)
        deepest = np.full(len(places), -np.inf)
        np.maximum.at(deepest, place, depth)
        # of the cells that share a place the one of the least number, whatever rounding says
        good = (depth >= np.minimum(-ROUNDING, deepest[place])) & (deepest[place] >= -MOST_OUTSIDE)
        np.minimum.at(cells, place[good], cell[good])
    far = np.flatnonzero(cells == mesh.cell_count)
    if len(far) and not extrapolate:
        raise MeshError(f"the place {places[far[0]].tolist()} is not in the body")
    centers = corners.mean(axis=1)
    for some in np.array_split(far, 1 + len(far) * len(centers) // (16 * PAIRS_AT_ONCE)):
        cells[some] = np.argmin((centers**2).sum(axis=1) - 2.0 * places[some] @ centers.T, axis=1)
    coordinates = _barycentric(places, corners[cells, 0], inverse[cells])
    own = shape(mesh.dim, mesh.order)
    if mesh.order == 2:
        coordinates = _curved(mesh, cells, coordinates, places)
    return Places(mesh.cells[cells], own.values(coordinates))


def _near(lower: np.ndarray, upper: np.ndarray, places: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of a place and a cell whose bounds contain it, some places with all their cells at a time.

    They are found by a regular grid, whose boxes know the cells that reach into them.

    Args:
        lower, upper: bounds of the cells (c, dim) [m].
        places: (k, dim) [m].

    Yields:
        Indices of places and of cells, one of each for a pair.
    """
    origin, width = lower.min(axis=0), float((upper - lower).mean())
    while True:
        first = np.floor((lower - origin) / width).astype(np.int64)
        spans = np.floor((upper - origin) / width).astype(np.int64) - first + 1
        extent = (first + spans).max(axis=0)
        boxes_in_all = spans.prod(axis=1, dtype=float).sum()  # float, as they may be more than integers can count
        if boxes_in_all <= MOST_BOXES * len(lower) and extent.prod(dtype=float) < MOST_NUMBERED:
            break
        width *= 2.0
    counts = spans.prod(axis=1)
    owners, within = _ranges(counts)
    boxes = np.zeros((len(owners), len(extent)), dtype=np.int64)
    for axis, span in enumerate(spans[owners].T):
        boxes[:, axis] = first[owners, axis] + within % span
        within = within // span
    keys = np.asarray(np.ravel_multi_index(tuple(boxes.T), tuple(extent)))
    order = np.argsort(keys, kind="stable")
    keys, owners = keys[order], owners[order]

    at = np.floor((places - origin) / width).astype(np.int64)
    inside = np.flatnonzero(((at >= 0) & (at < extent)).all(axis=1))
    own = np.asarray(np.ravel_multi_index(tuple(at[inside].T), tuple(extent)))
    begins = np.searchsorted(keys, own, side="left")
    counts = np.searchsorted(keys, own, side="right") - begins
    portions = np.cumsum(counts) // PAIRS_AT_ONCE
    for portion in np.split(np.arange(len(inside)), np.flatnonzero(np.diff(portions)) + 1):
        number, within = _ranges(counts[portion])
        place, cell = inside[portion[number]], owners[begins[portion[number]] + within]
        contains = ((lower[cell] <= places[place]) & (places[place] <= upper[cell])).all(axis=1)
        yield place[contains], cell[contains]


def _ranges(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each i the numbers 0..counts[i] - 1, one range after the other: i and the number, each (counts.sum(),)."""
    owners = np.repeat(np.arange(len(counts)), counts)
    return owners, np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)


def _barycentric(places: np.ndarray, origins: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (c, dim + 1) of places in cells with these first corners and inverted edges."""
    inner = np.einsum("cij,cj->ci", inverse, places - origins)
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
