"""The colliders of a stage that stand still, as obstacles."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from pxr import Usd, UsdGeom, UsdPhysics

from warpfem.boundary import Box, Obstacle, Plane, Sphere
from warpfem.usd.physics import tokens
from warpfem.usd.physics.view import StageView

FRICTION = ("physics:dynamicFriction", "physics:staticFriction")

_ROUNDING = 1e-5
"""How far a transform may be from one without shear, relative to its size."""


def read_obstacles(view: StageView, deformable: Collection[str]) -> tuple[Obstacle, ...]:
    """The colliders that warpfem has an obstacle for; the others are warned of.

    Args:
        view: the stage.
        deformable: the paths of prims that belong to deformable bodies.

    Raises:
        SceneError: one of them is broken.
    """
    obstacles: list[Obstacle] = []
    for prim in view.prims:
        if not prim.HasAPI(UsdPhysics.CollisionAPI) or str(prim.GetPath()) in deformable:
            continue
        if not view.switch(prim, "physics:collisionEnabled", True):
            continue
        reason = _reason_to_skip(view, prim)
        obstacle = None if reason else _obstacle(view, prim)
        if obstacle is None:
            kinds = "obstacles are planes, spheres and boxes without shear, spheres without unequal scales"
            view.warn(prim, f"is no obstacle: {reason or kinds}")
            continue
        if view.is_carried(prim):
            view.warn(prim, "moves, but obstacles stand still: it stays where it is at the start")
        obstacles.append(obstacle)
    return tuple(obstacles)


def is_free(view: StageView, body: Usd.Prim) -> bool:
    """Whether a rigid body moves freely, rather than standing still or being moved."""
    enabled = view.switch(body, "physics:rigidBodyEnabled", True)
    return enabled and not view.switch(body, "physics:kinematicEnabled", False)


def _reason_to_skip(view: StageView, prim: Usd.Prim) -> str:
    if view.is_prototype(prim):
        return "it is a prototype of a PointInstancer"
    above = prim
    while above and not above.IsPseudoRoot():
        if above.HasAPI(UsdPhysics.RigidBodyAPI):
            if is_free(view, above):
                return f"{above.GetPath()} is a rigid body that moves freely, which warpfem does not simulate"
            return ""
        above = above.GetParent()
    return ""


def _obstacle(view: StageView, prim: Usd.Prim) -> Obstacle | None:
    matrix = view.to_world(prim)
    linear, origin = matrix[:3, :3], matrix[3, :3].tolist()
    feel = _friction(view, prim), view.number(prim, tokens.STIFFNESS)
    if prim.IsA(UsdGeom.Plane):
        axis = np.eye(3)["XYZ".index(UsdGeom.Plane(prim).GetAxisAttr().Get(view.start))]
        return Plane(origin, (np.linalg.inv(linear) @ axis).tolist(), *feel)
    scales = np.linalg.norm(linear, axis=1)
    edges = linear / scales[:, None]
    if np.abs(edges @ edges.T - np.eye(3)).max() > _ROUNDING:
        return None
    if prim.IsA(UsdGeom.Sphere) and np.ptp(scales) <= _ROUNDING * scales.max():
        return Sphere(origin, UsdGeom.Sphere(prim).GetRadiusAttr().Get(view.start) * scales[0], *feel)
    if prim.IsA(UsdGeom.Cube):
        size = UsdGeom.Cube(prim).GetSizeAttr().Get(view.start) * scales
        return Box(origin, size.tolist(), edges.tolist(), *feel)
    return None


def _friction(view: StageView, prim: Usd.Prim) -> float:
    """The Coulomb coefficient of a collider's material: the dynamic one, and the static one where it is alone."""
    material = view.material(prim)
    if material is None:
        return 0.0
    dynamic, static = (view.number(material, name) for name in FRICTION)
    if dynamic is not None and static is not None and static != dynamic:
        view.warn(material, f"static friction {static:g} is not told from the dynamic one, {dynamic:g}, which is taken")
    if view.number(material, "physics:restitution"):
        view.warn(material, "restitution is left out: how bodies bounce follows from their elasticity")
    if dynamic is None:
        return 0.0 if static is None else static
    return dynamic
