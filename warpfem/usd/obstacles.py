"""Obstacles as prims: what a body rests on or bounces off should be seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from pxr import Gf, Usd, UsdGeom, Vt

from warpfem.boundary import Box, BoxWalls, Obstacle, Plane, Sphere
from warpfem.usd.prims import OBSTACLES, WORLD, extent_of, paint_obstacle, set_topology

Polygons: TypeAlias = tuple[np.ndarray, Sequence[np.ndarray] | np.ndarray]

_CORNERS = 64
"""Corners of a circle: its polygon is 0.12 % of the radius too small between them."""

_CUBE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])
_SIDES = np.array([(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)])


def define_obstacles(stage: Usd.Stage, obstacles: Sequence[Obstacle], lower: np.ndarray, upper: np.ndarray) -> None:
    """Authors the obstacles as meshes under ``/World/Obstacles``.

    A plane is drawn as far as four times the bodies' extent, as a quad (2D: a strip on its solid side),
    walls as a frame of bars around the box, so that one sees inside. In 2D all lie slightly behind the
    plane z = 0, so that they do not flicker with what presses into them. Spheres are meshes too: Blender
    imports the sphere primitive without its material and with ten corners around.

    Args:
        stage: the stage that has ``/World`` and its materials.
        obstacles: the obstacles, in 2D or 3D.
        lower, upper: (3,) bounds of all bodies at rest [m].
    """
    if not obstacles:
        return
    root = WORLD.AppendChild(OBSTACLES)
    UsdGeom.Xform.Define(stage, root)
    center, size = 0.5 * (lower + upper), float((upper - lower).max())
    for index, obstacle in enumerate(obstacles):
        points, faces = _polygons(obstacle, center, size)
        origin = 0.5 * (points.min(axis=0) + points.max(axis=0))
        local = (points - origin).astype(np.float32)
        mesh = UsdGeom.Mesh.Define(stage, root.AppendChild(f"{type(obstacle).__name__}_{index}"))
        set_topology(mesh, faces)
        mesh.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*origin))
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(local))
        mesh.CreateExtentAttr(extent_of(local))
        mesh.CreateDoubleSidedAttr(True)
        if isinstance(obstacle, Sphere) and len(obstacle.center) == 3:
            normals, interpolation = local, UsdGeom.Tokens.vertex
        else:
            a, b, c = (local[[face[corner] for face in faces]] for corner in range(3))
            normals, interpolation = np.cross(b - a, c - a), UsdGeom.Tokens.uniform
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
        mesh.SetNormalsInterpolation(interpolation)
        paint_obstacle(mesh)


def _polygons(obstacle: Obstacle, center: np.ndarray, size: float) -> Polygons:
    """Points (n, 3) float64 [m] and the corners of each polygon."""
    if isinstance(obstacle, Plane):
        return _quad(obstacle, center, size) if len(obstacle.point) == 3 else _strip(obstacle, center, size)
    if isinstance(obstacle, BoxWalls):
        return _bars(obstacle) if len(obstacle.lower) == 3 else _border(obstacle, size)
    if isinstance(obstacle, Box):
        return _block(obstacle) if len(obstacle.center) == 3 else _tile(obstacle, size)
    return _ball(obstacle) if len(obstacle.center) == 3 else _disc(obstacle, size)


def _behind(points: np.ndarray, size: float) -> np.ndarray:
    return np.column_stack([points, np.full(len(points), -1e-3 * size)])


def _ball(sphere: Sphere) -> Polygons:
    rings = _CORNERS // 2
    polar = np.linspace(0.0, np.pi, rings + 1)[1:-1, None]
    around = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
    circles = np.stack(
        np.broadcast_arrays(np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)), -1
    )
    points = np.concatenate([circles.reshape(-1, 3), [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]])
    grid = np.arange((rings - 1) * _CORNERS).reshape(rings - 1, _CORNERS)
    after = np.roll(grid, -1, axis=1)
    top, bottom = np.full(_CORNERS, grid.size), np.full(_CORNERS, grid.size + 1)
    quads = np.stack([grid[:-1], grid[1:], after[1:], after[:-1]], axis=-1).reshape(-1, 4)
    caps = np.concatenate([np.column_stack([top, grid[0], after[0]]), np.column_stack([bottom, after[-1], grid[-1]])])
    return np.array(sphere.center) + sphere.radius * points, [*quads, *caps]


def _disc(sphere: Sphere, size: float) -> Polygons:
    angles = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    return _behind(np.array(sphere.center) + sphere.radius * circle, size), [np.arange(_CORNERS)]


def _quad(plane: Plane, center: np.ndarray, size: float) -> Polygons:
    normal = np.array(plane.normal)
    middle = center - ((center - plane.point) @ normal) * normal
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across *= 2.0 * size / np.linalg.norm(across)
    along = np.cross(normal, across)
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return middle + signs @ np.stack([across, along]), np.array([[0, 1, 2, 3]])


def _strip(plane: Plane, center: np.ndarray, size: float) -> Polygons:
    normal = np.array(plane.normal)
    middle = center[:2] - ((center[:2] - plane.point) @ normal) * normal
    along = 2.0 * size * np.array([normal[1], -normal[0]])
    depth = -0.05 * size * normal
    corners = middle + np.stack([along, -along, depth - along, depth + along])
    return _behind(corners, size), np.array([[0, 1, 2, 3]])


def _border(box: BoxWalls, size: float) -> Polygons:
    lower, upper = np.array(box.lower), np.array(box.upper)
    signs = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    inner = lower + signs * (upper - lower)
    outer = inner + (2 * signs - 1) * 0.02 * (upper - lower).max()
    around = np.arange(4)
    after = np.roll(around, -1)
    faces = np.column_stack([around, around + 4, after + 4, after])
    return _behind(np.concatenate([inner, outer]), size), faces


def _corners(box: Box, signs: np.ndarray) -> np.ndarray:
    return np.array(box.center) + (0.5 * signs * np.array(box.size)) @ np.array(box.axes)


def _block(box: Box) -> Polygons:
    sides = _SIDES if np.linalg.det(box.shape) > 0.0 else _SIDES[:, ::-1]
    return _corners(box, 2 * _CUBE - 1), sides


def _tile(box: Box, size: float) -> Polygons:
    around = np.array([[0, 1, 2, 3]])
    corners = _corners(box, np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]))
    return _behind(corners, size), around if np.linalg.det(box.shape) > 0.0 else around[:, ::-1]


def _bars(box: BoxWalls) -> Polygons:
    lower, upper = np.array(box.lower), np.array(box.upper)
    thickness = 0.01 * (upper - lower).max()
    points: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    for axis in range(3):
        for ends in np.ndindex(2, 2):
            at_upper = np.insert(np.array(ends), axis, 0)
            start = np.where(at_upper, upper, lower - thickness)
            stop = np.where(at_upper, upper + thickness, lower)
            start[axis], stop[axis] = lower[axis], upper[axis]
            faces.append(_SIDES + 8 * len(points))
            points.append(start + _CUBE * (stop - start))
    return np.concatenate(points), np.concatenate(faces)
