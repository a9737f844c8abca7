"""What the writer is given: plain arrays, and the checks that USD does not make."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpfem.errors import OutputError


@dataclass(frozen=True, eq=False)
class UsdBody:
    """What never changes about a body.

    Attributes:
        name: any text; a valid and unique prim name is made of it, and it stays as the display name.
        rest_points: (n, 2 or 3) float64 rest positions [m]; 2D is drawn in the plane z = 0.
        cells: (m, 3) triangles in 2D or (m, 4) positively oriented tetrahedra in 3D, int32.
        surface_faces: (k, 3) int32; 3D: outward triangles, each a face of a cell; 2D: the cells themselves.

    Raises:
        OutputError: arrays of the wrong shape or type, rest points that are not finite, indices out of range.
    """

    name: str
    rest_points: np.ndarray
    cells: np.ndarray
    surface_faces: np.ndarray

    def __post_init__(self) -> None:
        points = np.asarray(self.rest_points)
        if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) == 0:
            raise OutputError(f"body {self.name!r}: rest_points must have shape (n, 2 or 3), not {points.shape}")
        if not np.isfinite(points).all():
            raise OutputError(f"body {self.name!r}: rest_points are not finite")
        for field, width in (("cells", points.shape[1] + 1), ("surface_faces", 3)):
            indices = np.asarray(getattr(self, field))
            if indices.ndim != 2 or indices.shape[1] != width or indices.dtype.kind not in "iu":
                raise OutputError(
                    f"body {self.name!r}: {field} must be integers of shape (n, {width}), "
                    f"not {indices.dtype} of shape {indices.shape}"
                )
            if len(indices) == 0 or indices.min() < 0 or indices.max() >= len(points):
                raise OutputError(f"body {self.name!r}: {field} must index its {len(points)} points")


@dataclass(frozen=True, eq=False)
class BodyFrame:
    """What one frame holds for one body of n points, m cells and dimension d.

    Attributes:
        points: (n, d) positions [m].
        velocities: (n, d) velocities [m/s].
        von_mises: (m,) von Mises stress of each cell [Pa].
        jacobian: (m,) J = det F of each cell.
    """

    points: np.ndarray
    velocities: np.ndarray
    von_mises: np.ndarray
    jacobian: np.ndarray


def in_space(vectors: np.ndarray) -> np.ndarray:
    """(n, 3) float64 of (n, 2 or 3) vectors: 2D lies in the plane z = 0."""
    vectors = np.asarray(vectors, np.float64)
    if vectors.shape[1] == 3:
        return vectors
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))


def as_float32(where: str, values: np.ndarray) -> np.ndarray:
    """Contiguous float32 values.

    Args:
        where: what the values are, for the message.
        values: (n,) or (n, d).

    Raises:
        OutputError: a value that is not a finite float32; names the first row.
    """
    with np.errstate(over="ignore"):
        single = np.ascontiguousarray(values, np.float32)
    if not np.isfinite(single).all():
        bad = np.flatnonzero(~np.isfinite(single.reshape(len(single), -1)).all(axis=1))
        raise OutputError(
            f"{where}: {len(bad)} of {len(single)} are not finite in float32, the first one is {bad[0]}: "
            f"{values[bad[0]]}; the run has diverged before this frame"
        )
    return single


class CellAverage:
    """From a value per cell to one per point: the average over its cells, weighted by their rest volumes."""

    def __init__(self, rest_points: np.ndarray, cells: np.ndarray) -> None:
        corners = rest_points[cells]
        self._volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
        self._corners = cells.shape[1]
        self._slots = cells.ravel().astype(np.intp)  # as np.bincount would convert them each time
        self._count = len(rest_points)
        self._weights = np.maximum(self._sum(self._volumes), np.finfo(float).tiny)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """(n,) float32 point values of (m,) cell values."""
        return (self._sum(self._volumes * values) / self._weights).astype(np.float32)

    def _sum(self, values: np.ndarray) -> np.ndarray:
        return np.bincount(self._slots, np.repeat(values, self._corners), minlength=self._count)


def cells_of_faces(body: UsdBody) -> np.ndarray:
    """(k,) index of the cell that each surface face belongs to.

    Raises:
        OutputError: a surface face that is no face of any cell.
    """
    cells = np.sort(body.cells, axis=1).astype(np.int64)
    sides = [cells] if cells.shape[1] == 3 else [np.delete(cells, corner, axis=1) for corner in range(4)]
    owners = np.tile(np.arange(len(cells)), len(sides))
    base = len(body.rest_points)
    weights = np.array([base * base, base, 1])
    keys = np.concatenate(sides) @ weights
    wanted = np.sort(body.surface_faces, axis=1).astype(np.int64) @ weights
    order = np.argsort(keys, kind="stable")
    slots = np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)
    found = order[slots]
    stray = np.flatnonzero(keys[found] != wanted)
    if len(stray):
        raise OutputError(
            f"body {body.name!r}: {len(stray)} surface faces belong to no cell, the first one is face "
            f"{stray[0]}: {body.surface_faces[stray[0]].tolist()}"
        )
    return owners[found]
