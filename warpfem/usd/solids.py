"""The solids that USD knows by their measures, as triangles for pictures."""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom

from warpfem.usd.stages import at_rest, world_matrix

_AROUND = 32
"""Corners of a sphere's circles."""


def is_solid(prim: Usd.Prim) -> bool:
    """Whether :func:`solid_corners` knows a prim."""
    return any(prim.IsA(kind) for kind in (UsdGeom.Plane, UsdGeom.Cube, UsdGeom.Sphere))


def solid_corners(prim: Usd.Prim) -> np.ndarray:
    """The triangles of a plane, cube or sphere at rest.

    Returns:
        (k, 3, 3) corners in the world [m], counter-clockwise as seen from outside; two triangles for a plane.
    """
    if prim.IsA(UsdGeom.Plane):
        corners = _plane(str(at_rest(UsdGeom.Plane(prim).GetAxisAttr())))
    elif prim.IsA(UsdGeom.Cube):
        corners = 0.5 * float(at_rest(UsdGeom.Cube(prim).GetSizeAttr())) * _cube()
    else:
        corners = float(at_rest(UsdGeom.Sphere(prim).GetRadiusAttr())) * _sphere()
    matrix = world_matrix(prim)
    corners = corners @ matrix[:3, :3] + matrix[3, :3]
    return corners[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0.0 else corners


def _plane(axis: str) -> np.ndarray:
    """A square of side 2 about the origin."""
    first, second = {"X": (1, 2), "Y": (2, 0)}.get(axis, (0, 1))
    square = np.zeros((4, 3))
    square[:, first], square[:, second] = (-1, 1, 1, -1), (-1, -1, 1, 1)
    return square[[(0, 1, 2), (0, 2, 3)]]


def _cube() -> np.ndarray:
    """From -1 to 1 along each axis."""
    sides = []
    for axis in "XYZ":
        square = _plane(axis) + np.eye(3)["XYZ".index(axis)]
        sides += [square, -square[:, ::-1]]
    return np.concatenate(sides)


def _sphere() -> np.ndarray:
    """Of radius 1, by circles of latitude."""
    turn = np.linspace(0.0, 2.0 * np.pi, _AROUND + 1)
    height = np.linspace(0.0, np.pi, _AROUND // 2 + 1)[:, None]
    points = np.stack(
        [np.sin(height) * np.cos(turn), np.sin(height) * np.sin(turn), np.cos(height) + 0.0 * turn], axis=2
    )
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    return np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)], axis=2).reshape(-1, 3, 3)
