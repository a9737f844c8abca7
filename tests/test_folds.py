"""Bodies that are folded into themselves, and those that only look odd."""

import numpy as np
import pytest

from warpfem.folds import folds
from warpfem.mesh import Mesh


def wound(mesh: Mesh, center: np.ndarray, turns: float) -> np.ndarray:
    """The points with their angles about an axis z through ``center`` multiplied, at unchanged distances."""
    x = mesh.points.copy()
    z = (x[:, 0] - center[0]) + 1j * (x[:, 1] - center[1])
    w = np.abs(z) * np.exp(1j * turns * np.angle(z))
    x[:, 0], x[:, 1] = w.real, w.imag
    return x


def octagon(height: int) -> Mesh:
    """Eight wedges about the origin, or about the z axis, so that they can be wound twice with J > 0."""
    angles = 2.0 * np.pi * np.arange(12) / 12
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    plane = np.vstack([[0.0, 0.0], ring])
    triangles = np.column_stack([np.zeros(12, int), 1 + np.arange(12), 1 + (np.arange(12) + 1) % 12])
    if not height:
        return Mesh(plane, triangles)
    n = len(plane)
    points = np.concatenate([np.column_stack([plane, np.full(n, z)]) for z in range(height + 1)])
    cells = []
    for layer in range(height):
        for a, b, c in triangles + layer * n:
            cells += [[a, b, c, c + n], [a, b, c + n, b + n], [a, b + n, c + n, a + n]]
    return Mesh.repaired(points, np.array(cells))


@pytest.mark.parametrize("height", [0, 2])
def test_cells_that_turn_twice_are_found(height):
    mesh = octagon(height)
    assert len(folds(mesh, mesh.points)) == 0
    twice = wound(mesh, np.zeros(2), 2.0)
    found = folds(mesh, twice)
    axis = {int(i) for i in np.flatnonzero(np.linalg.norm(mesh.points[:, :2], axis=1) == 0.0)}
    assert len(found) == max(height, 1)
    assert set(found.ravel().tolist()) <= axis


@pytest.mark.parametrize("dim", [2, 3])
def test_what_is_only_bent_or_turned_is_not_folded(dim):
    mesh = Mesh.rectangle((4.0, 1.0), (16, 4)) if dim == 2 else Mesh.box((4.0, 1.0, 1.0), (16, 4, 4))
    x = mesh.points.copy()
    angle, radius = 1.9 * np.pi * x[:, 0] / 4.0, 4.0 / (1.9 * np.pi) + x[:, 1] - 0.5
    x[:, 0], x[:, 1] = radius * np.sin(angle), -radius * np.cos(angle)  # nearly a closed ring
    assert len(folds(mesh, x)) == 0
