"""Whether a body has folded into itself: all its cells may have J > 0, and yet turn twice about one of its edges.

A mesh that deforms without inverting a cell keeps the angles about each inner edge (2D: point) at one full turn.
One that got there through inverted cells can be caught at two: a minimum of the energy that no motion without
inversion leads out of.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from warpfem.mesh import Mesh


def folds(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """The inner edges (2D: points) about which the cells turn more than once.

    Args:
        mesh: the mesh.
        points: current positions (point_count, dim) [m].

    Returns:
        Point numbers, (k, 2) of the ends of edges in 3D or (k, 1) in 2D.
    """
    corners, cells = mesh.dim + 1, mesh.linear_cells
    hinges, angles = [], []
    for hinge in combinations(range(corners), mesh.dim - 1):
        first, second = (points[cells[:, k]] for k in range(corners) if k not in hinge)
        origin = points[cells[:, hinge[0]]]
        first, second = first - origin, second - origin
        if len(hinge) == 2:
            axis = points[cells[:, hinge[1]]] - origin
            first, second = _across(first, axis), _across(second, axis)
        hinges.append(np.sort(cells[:, hinge], axis=1))
        angles.append(_angle(first, second))
    rows = np.concatenate(hinges)
    keys, first_rows, inverse = np.unique(_keys(rows, mesh.point_count), return_index=True, return_inverse=True)
    turns = np.bincount(inverse, np.concatenate(angles)) / (2.0 * np.pi)
    faces = mesh.linear_boundary_faces
    outer = np.concatenate([np.sort(faces[:, hinge], axis=1) for hinge in combinations(range(mesh.dim), mesh.dim - 1)])
    inner = ~np.isin(keys, _keys(outer, mesh.point_count))
    return rows[first_rows[inner & (turns > 1.5)]]


def _across(vectors: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """The part of each vector that is perpendicular to its axis."""
    square = np.maximum(np.einsum("ci,ci->c", axes, axes), np.finfo(np.float64).tiny)
    return vectors - (np.einsum("ci,ci->c", vectors, axes) / square)[:, None] * axes


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    area = np.sqrt(np.maximum(np.einsum("ci,ci,cj,cj->c", a, a, b, b) - np.einsum("ci,ci->c", a, b) ** 2, 0.0))
    return np.arctan2(area, np.einsum("ci,ci->c", a, b))


def _keys(rows: np.ndarray, bound: int) -> np.ndarray:
    return rows.astype(np.int64) @ bound ** np.arange(rows.shape[1], dtype=np.int64)
