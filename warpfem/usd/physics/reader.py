"""Reads a stage as a scene, in a child process."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, UsdPhysics

from warpfem.child import read_in_child
from warpfem.errors import SceneError, one_line
from warpfem.usd.physics import tokens
from warpfem.usd.physics.attachments import read_pins
from warpfem.usd.physics.bodies import body_prim, governed, read_bodies
from warpfem.usd.physics.colliders import FRICTION, is_free, read_obstacles
from warpfem.usd.physics.data import StageScene
from warpfem.usd.physics.view import StageView, applied
from warpfem.usd.stages import open_stage, reporting

_PHYSICS = ("Physics", "Physx", "OmniPhysics", "Newton", "Mjc")
"""How the names of schemas for physics begin, also those of vendors."""

_UNDERSTOOD = {
    tokens.BODY_API,
    tokens.SIMULATION_API,
    tokens.MATERIAL_API,
    tokens.POSE_API,
    tokens.ATTACHMENT,
    "PhysicsScene",
    "PhysicsBodyAPI",
    "PhysicsCollisionAPI",
    "PhysicsMeshCollisionAPI",  # says how to approximate a collider, of which there is a warning of its own
    "PhysicsMaterialAPI",
    "PhysicsRigidBodyAPI",  # of one that moves freely
}

_MOST_WARNINGS = 20
"""Of prims that are passed over for what they are: a robot has thousands."""


def read_stage_scene(path: str | Path) -> StageScene:
    """Reads the volume deformables of a USD stage, with the gravity and the obstacles around them.

    Raises:
        SceneError: a file that is missing or unreadable, nothing to simulate, or a prim that is broken.
    """
    return read_in_child(stage_scene, path, SceneError)


def stage_scene(path: str) -> StageScene:
    """What :func:`read_stage_scene` returns; called in a child process."""
    stage = open_stage(path, SceneError)
    with reporting(f"{path} cannot be read as USD", SceneError):
        for problem in stage.GetCompositionErrors():
            warnings.warn(f"{path}: {one_line(str(problem))}", stacklevel=2)
        view = StageView(stage, path)
        bodies = read_bodies(view, read_pins(view))
        if not bodies:
            raise SceneError(f"{path}: there is nothing to simulate: {_what_is_there(view)}")
        prims = [prim for prim in view.prims if tokens.BODY_API in applied(prim)]
        prims += [body_prim(prim) for prim in view.prims if tokens.SIMULATION_API in applied(prim)]
        obstacles = read_obstacles(view, governed(prims))
        gravity, damping = _gravity(view)
        if obstacles:
            _warn_of_bodies_that_collide(view, [stage.GetPrimAtPath(body.place.path) for body in bodies])
        _warn_of_the_unknown(view)
        fps, frames = _clock(stage, path)
        files = tuple(sorted({layer.realPath for layer in stage.GetUsedLayers() if layer.realPath}))
    return StageScene(bodies, gravity, obstacles, str(UsdGeom.GetStageUpAxis(stage)), fps, frames, damping, files)


def _what_is_there(view: StageView) -> str:
    tets = [str(prim.GetPath()) for prim in view.prims if prim.IsA(UsdGeom.TetMesh)]
    if not tets:
        return (
            f"it has no TetMesh with {tokens.SIMULATION_API}. In a scene file, wf.load_mesh fills a surface with cells"
        )
    return f"no TetMesh can be, of {', '.join(tets[:5])}: apply {tokens.SIMULATION_API} to what is to be simulated"


def _gravity(view: StageView) -> tuple[tuple[float, float, float] | None, float]:
    """The acceleration [m/s^2], and the damping [1/s] that scenes of warpfem have."""
    scenes = [prim for prim in view.prims if prim.IsA(UsdPhysics.Scene)]
    for prim in scenes[1:]:
        view.warn(prim, f"is left out: all bodies are simulated in the first scene, {scenes[0].GetPath()}")
    down = np.array([0.0, -1.0, 0.0] if UsdGeom.GetStageUpAxis(view.stage) == "Y" else [0.0, 0.0, -1.0])
    magnitude, direction, damping = tokens.EARTH, down, 0.0
    if scenes:
        own = UsdPhysics.Scene(scenes[0])
        given = view.number(scenes[0], "physics:gravityMagnitude")
        if given is not None and given >= 0.0:  # what is below stands for that of the earth
            magnitude = given * view.length
        if not math.isfinite(magnitude) or given != given:
            raise view.error(scenes[0], f"physics:gravityMagnitude must be a finite number, not {given}")
        stated = np.array(own.GetGravityDirectionAttr().Get(view.start), float)
        if not np.isfinite(stated).all():
            raise view.error(scenes[0], "physics:gravityDirection has numbers that are not finite")
        if stated.any():
            direction = stated / np.linalg.norm(stated)
        damping = view.number(scenes[0], tokens.DAMPING) or 0.0
    else:
        warnings.warn(f"{view.path}: there is no PhysicsScene: gravity is {tokens.EARTH} m/s^2, down", stacklevel=2)
    x, y, z = (magnitude * direction).tolist()
    return (None if magnitude == 0.0 else (x, y, z)), damping


def _clock(stage: Usd.Stage, path: str) -> tuple[float, int | None]:
    """Frames per second, and their number after the initial one, if there is a range."""
    codes = stage.GetTimeCodesPerSecond()
    stated = stage.HasAuthoredMetadata("framesPerSecond")
    fps = stage.GetFramesPerSecond() if stated else codes
    if not (math.isfinite(fps) and fps > 0.0 and math.isfinite(codes) and codes > 0.0):
        raise SceneError(f"{path}: framesPerSecond and timeCodesPerSecond must be above 0, not {fps:g} and {codes:g}")
    span = stage.GetEndTimeCode() - stage.GetStartTimeCode() if stage.HasAuthoredTimeCodeRange() else 0.0
    return fps, round(span * fps / codes) if math.isfinite(span) and span > 0.0 else None


def _warn_of_bodies_that_collide(view: StageView, prims: list[Usd.Prim]) -> None:
    """All bodies touch all obstacles, whether they have a collider or not."""
    for prim in prims:
        own = list(governed([body_prim(prim)]))
        colliders = [view.stage.GetPrimAtPath(path) for path in own]
        colliders = [
            other
            for other in colliders
            if other.HasAPI(UsdPhysics.CollisionAPI) and view.switch(other, "physics:collisionEnabled", True)
        ]
        if not colliders:
            view.warn(prim, "has no collider, but touches the obstacles all the same")
        material = view.material(prim)
        if material and any(view.number(material, name) for name in FRICTION):
            view.warn(prim, f"the friction of {material.GetPath()} is left out: that of the obstacles counts")
        for other in colliders:
            if other != prim:
                view.warn(other, f"the tetrahedra of {prim.GetPath()} touch the obstacles instead of this collider")


def _warn_of_the_unknown(view: StageView) -> None:
    unknown: list[tuple[Usd.Prim, str]] = []
    for prim in view.prims:
        names = [str(prim.GetTypeName()), *(name.partition(":")[0] for name in applied(prim))]
        strange = [name for name in names if name.startswith(_PHYSICS) and name not in _UNDERSTOOD]
        if prim.HasAPI(UsdPhysics.RigidBodyAPI) and is_free(view, prim):
            strange.append("PhysicsRigidBodyAPI")
        if strange:
            unknown.append((prim, ", ".join(dict.fromkeys(strange))))
    for prim, names_of_it in unknown[:_MOST_WARNINGS]:
        view.warn(prim, f"{names_of_it} is not understood, and left out")
    if len(unknown) > _MOST_WARNINGS:
        rest = len(unknown) - _MOST_WARNINGS
        warnings.warn(f"{view.path}: {rest} more prims have physics that is not understood", stacklevel=2)
