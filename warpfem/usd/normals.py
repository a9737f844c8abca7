"""Normals of a surface that moves: smooth where it is round at rest, apart where it has an edge."""

from __future__ import annotations

import numpy as np

SHARPEST = 60.0
"""Angle between the normals of two faces [degrees] above which they meet at an edge: round bodies of coarse cells have
less, boxes and cylinders more."""


class SurfaceNormals:
    """The normals of a surface: one for the faces around a point that no edge parts.

    Attributes:
        indices: the normal of each corner of each face, (k, 3) int32.
        creased: whether a point has more than one; if none has, normals are numbered as the points.
    """

    def __init__(self, rest_points: np.ndarray, faces: np.ndarray) -> None:
        """Looks for edges.

        Args:
            rest_points: (n, 3) positions at rest, each used by a face.
            faces: (k, 3) int32 triangles.
        """
        corners = faces.ravel()
        smooth = _joined(len(corners), *_smooth_pairs(_area_vectors(rest_points, faces), faces))
        _, first, indices = np.unique(smooth, return_index=True, return_inverse=True)
        self.creased = len(first) > len(rest_points)
        self.indices = (indices.reshape(faces.shape) if self.creased else faces).astype(np.int32)
        self._faces = faces
        self._count = max(len(first), len(rest_points))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Unit normals at (n, 3) positions, (m, 3) float32: the sums of the area vectors of the faces around."""
        areas = np.repeat(_area_vectors(points, self._faces), 3, axis=0)
        numbers = self.indices.ravel()
        summed = np.column_stack([np.bincount(numbers, axis, minlength=self._count) for axis in areas.T])
        lengths = np.linalg.norm(summed, axis=1, keepdims=True)
        return (summed / np.where(lengths > 0.0, lengths, 1.0)).astype(np.float32)


def _area_vectors(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Twice the area times the normal of each face, (k, 3) float64."""
    a, b, c = (points[faces[:, corner]].astype(np.float64) for corner in range(3))
    return np.cross(b - a, c - a)


def _smooth_pairs(areas: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of corners, numbered face by face, that are at the same point on both sides of a line that is no edge."""
    number = np.arange(faces.size).reshape(faces.shape)
    points = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    corners = np.concatenate([number[:, [0, 1]], number[:, [1, 2]], number[:, [2, 0]]])
    turned = points[:, 0] > points[:, 1]
    points[turned], corners[turned] = points[turned, ::-1], corners[turned, ::-1]
    order = np.lexsort(points.T)
    points, corners = points[order], corners[order]
    same = (points[1:] == points[:-1]).all(axis=1)
    one, other = corners[:-1][same], corners[1:][same]
    lengths = np.linalg.norm(areas, axis=1, keepdims=True)
    normals = areas / np.where(lengths > 0.0, lengths, 1.0)
    cosines = np.einsum("ij,ij->i", normals[one[:, 0] // 3], normals[other[:, 0] // 3])
    smooth = cosines >= np.cos(np.radians(SHARPEST))
    return one[smooth].ravel(), other[smooth].ravel()


def _joined(count: int, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The least number that each of ``count`` things is joined to by pairs, directly or through others."""
    label = np.arange(count)
    while True:
        least = np.minimum(label[one], label[other])
        lower = label.copy()
        np.minimum.at(lower, one, least)
        np.minimum.at(lower, other, least)
        lower = lower[lower]
        if (lower == label).all():
            return label
        label = lower
