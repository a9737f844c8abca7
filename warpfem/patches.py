"""Patches: groups of neighbouring cells that share one volumetric strain (see averaged.py)."""

from __future__ import annotations

import numpy as np

from warpfem.mesh import Mesh

ROUNDS = {2: 2, 3: 3}
"""Rounds in which patches pair with a neighbour, by dimension: patches of up to 4 triangles or 8 tetrahedra."""

LARGEST_RATIO = 2.0
"""The largest ratio of two cells' moduli with which they may share a patch."""


def cell_patches(mesh: Mesh, modulus: np.ndarray) -> np.ndarray:
    """Divides the cells into disjoint connected patches of about 2^dim cells.

    In each round every patch chooses the neighbour with which it shares the largest area, and those that choose each
    other become one. What is left alone in the end joins its smallest neighbour. The result is always the same.

    Args:
        mesh: the mesh.
        modulus: (cell_count,) float64, > 0. Neighbours whose moduli differ by more than ``LARGEST_RATIO`` are
            kept apart, where no others lead from one to the other.

    Returns:
        (cell_count,) int32, the patch of each cell, numbered in the order of their first cells.
    """
    first, second, area = _inner_faces(mesh)
    ratio = modulus[first] / modulus[second]
    alike = np.maximum(ratio, 1.0 / ratio) <= LARGEST_RATIO
    first, second, area = first[alike], second[alike], area[alike]
    patch = np.arange(mesh.cell_count)
    for _ in range(ROUNDS[mesh.dim]):
        patch = _pair(patch, *_links(patch[first], patch[second], area))
    patch = _join_small(patch, first, second, 2**mesh.dim)
    _, start, patch = np.unique(patch, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(start))[patch].astype(np.int32)


def _inner_faces(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The two cells of each inner face, and its area."""
    corners = mesh.dim + 1
    sides = [np.delete(np.arange(corners), k) for k in range(corners)]
    faces = np.sort(mesh.cells[:, sides].reshape(-1, mesh.dim), axis=1)
    order = np.lexsort(faces.T)
    faces = faces[order]
    twins = np.flatnonzero((faces[1:] == faces[:-1]).all(axis=1))
    x = mesh.points[faces[twins]]
    spans = x[:, 1:] - x[:, :1]
    area = np.sqrt(np.linalg.det(spans @ spans.transpose(0, 2, 1)))
    return order[twins] // corners, order[twins + 1] // corners, area


def _links(first: np.ndarray, second: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pairs of patches that touch, each once with the smaller number first, and the area that they share."""
    low, high = np.minimum(first, second), np.maximum(first, second)
    apart = low != high
    count = int(high.max(initial=0)) + 1
    keys, place = np.unique(low[apart].astype(np.int64) * count + high[apart], return_inverse=True)
    return keys // count, keys % count, np.bincount(place, area[apart], len(keys))


def _pair(patch: np.ndarray, first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Merges patches that choose each other by weight; ties fall by lot, so that few rounds of choosing suffice."""
    lot = np.random.default_rng(0).permutation(len(weight))
    rank = np.empty(len(weight), dtype=np.int64)
    rank[np.lexsort((lot, np.round(weight / weight.max(initial=0.0), 6)))] = np.arange(len(weight))
    target = np.arange(patch.max() + 1)
    while len(first):
        best = np.full(len(target), -1)
        np.maximum.at(best, first, rank)
        np.maximum.at(best, second, rank)
        chosen = (best[first] == rank) & (best[second] == rank)
        target[second[chosen]] = first[chosen]
        taken = np.zeros(len(target), dtype=bool)
        taken[first[chosen]] = taken[second[chosen]] = True
        free = ~(taken[first] | taken[second])
        first, second, rank = first[free], second[free], rank[free]
    return target[patch]


def _join_small(patch: np.ndarray, first: np.ndarray, second: np.ndarray, least: int) -> np.ndarray:
    """Lets patches of fewer than ``least`` cells join the smallest one beside them."""
    while True:
        size = np.bincount(patch)
        low, high, _ = _links(patch[first], patch[second], np.ones(len(first)))
        small = np.minimum(size[low], size[high]) < least
        if not small.any():
            return patch
        low, high = low[small], high[small]
        patch = _pair(patch, low, high, 1.0 / (size[low] + size[high]))
