"""Obstacles as prims: what a body rests on or bounces off should be seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pxr import Gf, Usd, UsdGeom, Vt

from warpfem.boundary import BoxWalls, Obstacle, Plane, Sphere
from warpfem.usd.prims import OBSTACLES, WORLD, define_obstacle, extent_of, set_topology

_DISC_CORNERS = 96


def define_obstacles(
    stage: Usd.Stage, obstacles: Sequence[Obstacle], lower: np.ndarray, upper: np.ndarray
) -> None:
    """Authors the obstacles under ``/World/Obstacles``.

    A plane is drawn as far as four times the bodies' extent, as a quad (2D: a strip on its solid side), a
    sphere as a sphere (2D: a disc), walls as a frame of bars around the box, so that one sees inside. In 2D
    all lie slightly behind the plane z = 0, so that they do not flicker with what presses into them.

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
        path = root.AppendChild(f"{type(obstacle).__name__}_{index}")
        if isinstance(obstacle, Sphere) and len(obstacle.center) == 3:
            prim = UsdGeom.Sphere.Define(stage, path)
            prim.CreateRadiusAttr(obstacle.radius)
            prim.CreateExtentAttr(Vt.Vec3fArray([Gf.Vec3f(-obstacle.radius), Gf.Vec3f(obstacle.radius)]))
            origin = np.array(obstacle.center)
        else:
            points, faces = _polygons(obstacle, center, size)
            origin = 0.5 * (points.min(axis=0) + points.max(axis=0))
            prim = UsdGeom.Mesh.Define(stage, path)
            set_topology(prim, faces)
            local = (points - origin).astype(np.float32)
            prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(local))
            prim.CreateExtentAttr(extent_of(local))
            prim.CreateDoubleSidedAttr(True)
        UsdGeom.Xformable(prim).AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*origin))
        define_obstacle(prim)


def _polygons(obstacle: Obstacle, center: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) [m] and polygons (m, corners) of an obstacle."""
    if isinstance(obstacle, Plane):
        if len(obstacle.point) == 3:
            return _quad(obstacle, center, size)
        points, faces = _strip(obstacle, center[:2], size)
    elif isinstance(obstacle, BoxWalls):
        if len(obstacle.lower) == 3:
            return _bars(obstacle)
        points, faces = _border(obstacle)
    else:
        angles = np.linspace(0.0, 2.0 * np.pi, _DISC_CORNERS, endpoint=False)
        points = np.array(obstacle.center) + obstacle.radius * np.column_stack(
            [np.cos(angles), np.sin(angles)]
        )
        faces = np.arange(_DISC_CORNERS)[None]
    return np.column_stack([points, np.full(len(points), -1e-3 * size)]), faces


def _quad(plane: Plane, center: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    normal = np.array(plane.normal)
    middle = center - ((center - plane.point) @ normal) * normal
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across *= 2.0 * size / np.linalg.norm(across)
    along = np.cross(normal, across)
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return middle + signs @ np.stack([across, along]), np.array([[0, 1, 2, 3]])


def _strip(plane: Plane, center: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    normal = np.array(plane.normal)
    middle = center - ((center - plane.point) @ normal) * normal
    along = 2.0 * size * np.array([normal[1], -normal[0]])
    depth = -0.05 * size * normal
    return middle + np.stack([along, -along, -along + depth, along + depth]), np.array([[0, 1, 2, 3]])


def _border(box: BoxWalls) -> tuple[np.ndarray, np.ndarray]:
    lower, upper = np.array(box.lower), np.array(box.upper)
    signs = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    inner = lower + signs * (upper - lower)
    outer = inner + (2 * signs - 1) * 0.02 * (upper - lower).max()
    around = np.arange(4)
    after = np.roll(around, -1)
    return np.concatenate([inner, outer]), np.column_stack([around, around + 4, after + 4, after])


def _bars(box: BoxWalls) -> tuple[np.ndarray, np.ndarray]:
    lower, upper = np.array(box.lower), np.array(box.upper)
    thickness = 0.01 * (upper - lower).max()
    corners = np.array(
        [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    )
    sides = np.array([(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)])
    points, faces = [], []
    for axis in range(3):
        for ends in np.ndindex(2, 2):
            at_upper = np.insert(np.array(ends), axis, 0)
            start = np.where(at_upper, upper, lower - thickness)
            stop = np.where(at_upper, upper + thickness, lower)
            start[axis], stop[axis] = lower[axis], upper[axis]
            faces.append(sides + 8 * len(points))
            points.append(start + corners * (stop - start))
    return np.concatenate(points), np.concatenate(faces)
