"""The rigid motions that supports leave free to bodies, and to the parts of bodies that nothing connects."""

from __future__ import annotations

import numpy as np

from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.scene import Body


def free_rigid_modes(model: Model, index: int) -> list[tuple[str, list[str]]]:
    """The rigid motions, for small angles, that supports leave free to the connected parts of a body.

    Args:
        model: the model.
        index: number of the body in the scene.

    Returns:
        For each part that can move, its name, empty if the body is of one piece, and the motions in words.
    """
    body = model.scene.bodies[index]
    points, held = _held(model, index)
    parts = connected_parts(body.mesh)
    result = []
    for number in np.unique(parts):
        own = parts[points] == number
        modes = _free_modes(body, points[own], held[own])
        name = f", the part with point {number}," if parts.any() else ""
        if modes:
            result.append((name, modes))
    return result


def connected_parts(mesh: Mesh) -> np.ndarray:
    """For each point the least number of a point that cells connect it with, (point_count,)."""
    parts = np.arange(mesh.point_count)
    while True:
        least = parts[mesh.cells].min(axis=1)
        lower = parts.copy()
        np.minimum.at(lower, mesh.cells, least[:, None])
        lower = lower[lower]  # of that point in turn: few rounds suffice
        if (lower == parts).all():
            return parts
        parts = lower


def _free_modes(body: Body, points: np.ndarray, held: np.ndarray) -> list[str]:
    dim = body.mesh.dim
    origin = body.mesh.points[points].mean(axis=0) if len(points) else body.mesh.points.mean(axis=0)
    size = float(np.linalg.norm(np.ptp(body.mesh.bounding_box, axis=0)))
    arms = (body.mesh.points[points] - origin) / size
    turns = _turns(dim)
    motions = np.concatenate(
        [np.broadcast_to(np.eye(dim), (len(points), dim, dim)), np.einsum("rij,pj->pri", turns, arms)], axis=1
    )
    rows = motions.transpose(0, 2, 1)[held]
    free = _null_space(rows, dim + len(turns))
    return [_in_words(mode, origin, size) for mode in free]


def _held(model: Model, index: int) -> tuple[np.ndarray, np.ndarray]:
    """The held points of a body, by their numbers in its mesh, and which of their components (k, dim) bool."""
    if model.supports is None:
        return np.empty(0, dtype=np.int64), np.empty((0, model.dim), dtype=bool)
    points, (body, _) = model.supports.host_points, model.body_slices[index]
    own = (points >= body.start) & (points < body.stop)
    return points[own] - body.start, model.supports.held.numpy()[own] > 0.0


def _turns(dim: int) -> np.ndarray:
    """The matrices of small turns: one in the plane, three in space."""
    if dim == 2:
        return np.array([[[0.0, -1.0], [1.0, 0.0]]])
    turns = np.zeros((3, 3, 3))
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        turns[axis, b, a], turns[axis, a, b] = 1.0, -1.0
    return turns


def _null_space(rows: np.ndarray, count: int) -> np.ndarray:
    """A basis of what the rows (k, count) leave free, each vector with a 1 where the others have 0."""
    if len(rows):
        _, values, Vt = np.linalg.svd(rows, full_matrices=True)
        rank = int((values > 1e-9 * max(1.0, values[0])).sum())
        basis = Vt[rank:]
    else:
        basis = np.eye(count)
    lead = 0
    for row in range(len(basis)):  # reduced echelon form
        while lead < count and np.abs(basis[row:, lead]).max() < 1e-9:
            lead += 1
        pivot = row + int(np.argmax(np.abs(basis[row:, lead])))
        basis[[row, pivot]] = basis[[pivot, row]]
        basis[row] /= basis[row, lead]
        for other in range(len(basis)):
            if other != row:
                basis[other] -= basis[other, lead] * basis[row]
        lead += 1
    return basis


def _in_words(mode: np.ndarray, origin: np.ndarray, size: float) -> str:
    dim = len(origin)
    shift, turn = mode[:dim], mode[dim:] / size
    if np.abs(turn).max() * size < 1e-9:
        return f"translation along {_direction(shift)}"
    if dim == 2:
        center = origin + np.array([-shift[1], shift[0]]) / turn[0]
        return f"rotation about {_place(center)}"
    center = origin + np.cross(turn, shift) / (turn @ turn)
    pitch = abs(turn @ shift) / np.linalg.norm(turn)
    kind = "rotation" if pitch < 1e-9 else "screw motion"
    return f"{kind} about {_direction(turn)} through {_place(center)}"


def _direction(vector: np.ndarray) -> str:
    unit = vector / np.abs(vector).max()
    axis = int(np.argmax(np.abs(unit)))
    if np.abs(np.delete(unit, axis)).max() < 1e-9:
        return "xyz"[axis]
    return _place(unit)


def _place(point: np.ndarray) -> str:
    return f"({', '.join(f'{c:.6g}' for c in np.round(point, 9) + 0.0)})"
