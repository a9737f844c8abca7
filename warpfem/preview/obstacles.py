"""Obstacles in a picture: as much of them as is near the motion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

_NEAR, _WHOLE = 0.2, 2.5
"""In sizes of the motion: how near obstacles are drawn, and how large ones are drawn whole."""


@dataclass(frozen=True, eq=False)
class Obstacle:
    """An obstacle, or a part of one: ``corners`` (k, 3, 3) of its triangles [m], and whether it is a plane."""

    corners: np.ndarray
    is_plane: bool

    @classmethod
    def whole(cls, corners: np.ndarray, is_plane: bool, flat: bool) -> Obstacle:
        """All of an obstacle in a file, which holds just a piece of a plane: two triangles.

        In 2D that piece is a strip on the solid side, and its first two corners are on the surface.
        """
        if is_plane:
            middle = corners[0, :2].mean(axis=0) if flat else corners.mean(axis=(0, 1))
            corners = middle + 1e4 * (corners - middle)
        return cls(corners, is_plane)

    @cached_property
    def normal(self) -> np.ndarray:
        """(3,) unit normal of a plane."""
        normals = normals_of(self.corners)
        return normals[np.abs(normals).sum(axis=1).argmax()]  # clipping makes triangles without area

    def near(self, lower: np.ndarray, upper: np.ndarray) -> Obstacle:
        """What is near to a motion within (3,) bounds [m]: everything, if that is not much larger."""
        size = (upper - lower).max()
        lower, upper = lower - _NEAR * size, upper + _NEAR * size
        first, last = self.corners.min(axis=1), self.corners.max(axis=1)
        start, stop = first.min(axis=0), last.max(axis=0)
        if (start <= upper).all() and (stop >= lower).all() and (stop - start).max() < _WHOLE * size:
            return self
        inside = ((first >= lower) & (last <= upper)).all(axis=1)
        crossing = ((first <= upper) & (last >= lower)).all(axis=1) & ~inside
        parts = [_fan(_clipped(triangle, lower, upper)) for triangle in self.corners[crossing]]
        return Obstacle(np.concatenate([self.corners[inside], *parts]), self.is_plane)


def _clipped(polygon: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The part of a convex polygon (n, 3) within bounds, by Sutherland and Hodgman's method."""
    for axis, sign, bound in [(axis, sign, bound) for sign, bound in ((1, lower), (-1, upper)) for axis in range(3)]:
        depth = sign * (polygon[:, axis] - bound[axis])
        after, depth_after = np.roll(polygon, -1, axis=0), np.roll(depth, -1)
        crosses = (depth >= 0.0) != (depth_after >= 0.0)
        share = depth / np.where(crosses, depth - depth_after, 1.0)
        crossings = polygon + share[:, None] * (after - polygon)
        polygon = np.stack([polygon, crossings], axis=1)[np.column_stack([depth >= 0.0, crosses])]
    return polygon


def _fan(polygon: np.ndarray) -> np.ndarray:
    """The triangles (n - 2, 3, 3) of a convex polygon (n, 3)."""
    first = np.broadcast_to(polygon[:1], polygon.shape)
    return np.stack([first, polygon, np.roll(polygon, -1, axis=0)], axis=1)[1:-1]


def normals_of(corners: np.ndarray) -> np.ndarray:
    """(k, 3) unit normals of triangles (k, 3, 3); zero where a triangle has no area."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0.0, lengths, 1.0)
