"""Scenes out of USD stages that have physics on them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpfem.boundary import Pin
from warpfem.errors import WarpfemError
from warpfem.materials import MATERIALS, StableNeoHookean
from warpfem.mesh import Mesh
from warpfem.scene import Body, Scene
from warpfem.solvers import BackwardEuler

if TYPE_CHECKING:
    from warpfem.usd.physics.data import StageBody

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
"""How the names of stages end."""

STEP = 1.0 / 120.0
"""Time step of stages [s]: they have no word for it."""


def read_stage(path: str | Path, dt: float = STEP) -> Scene:
    """Reads a USD stage as a scene.

    Simulated is each ``TetMesh`` with ``PhysicsVolumeDeformableSimAPI``, as the proposal for deformable bodies in
    UsdPhysics has it (AOUSD, ``wp_deformable_physics``, 2026): with ``physics:youngsModulus``,
    ``physics:poissonsRatio`` and ``physics:density`` of the material that is bound to it for physics, its masses or
    those of the ``PhysicsDeformableBodyAPI`` above it, ``physics:restShapePoints``, ``velocities``, and hard
    attachments of its points to a fixed frame. ``UsdPhysics.Scene`` gives gravity. ``Plane``, ``Sphere`` and ``Cube``
    prims with ``CollisionAPI`` are obstacles with the friction of their material; planes have no end. All is read at
    the stage's first time code, in its units and with its transforms; axes stay as they are. The frames are those of
    its time codes.

    A stage names neither a material model nor a solver: these are ``StableNeoHookean`` and ``BackwardEuler()``.
    What is not understood is warned of, prim by prim.

    Args:
        path: a ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file. What it refers to is read, too.
        dt: time step [s].

    Raises:
        SceneError: the file is missing, damaged, or has nothing to simulate; or a prim is broken.
        MeshError, MaterialError: a mesh or a material that cannot be simulated, with its prim.
    """
    from warpfem.usd import read_stage_scene

    stage = read_stage_scene(path)
    bodies = [_body(str(path), body) for body in stage.bodies]
    return Scene(
        bodies,
        BackwardEuler(),
        dt=dt,
        gravity=stage.gravity,
        obstacles=stage.obstacles,
        damping=stage.damping,
        fps=stage.fps,
        frames=Scene.frames if stage.frames is None else stage.frames,
        up_axis="Y" if stage.up_axis == "Y" else "Z",
    )


def _body(path: str, body: StageBody) -> Body:
    with _naming(f"{path}, {body.place.path}"):
        mesh = Mesh.repaired(body.rest_points, body.cells)
        material = MATERIALS.get(body.material, StableNeoHookean)(E=body.youngs_modulus, nu=body.poissons_ratio)
        displacement = body.start_points - body.rest_points
        return Body(
            body.name,
            mesh,
            material,
            density=body.density,
            supports=[Pin(body.pins)] if len(body.pins) else [],
            displacement=displacement if displacement.any() else None,
            velocity=body.velocities if np.any(body.velocities) else None,
        )


@contextmanager
def _naming(where: str) -> Iterator[None]:
    """Says which prim it is that is wrong."""
    try:
        yield
    except WarpfemError as error:
        raise type(error)(f"{where}: {error}") from error
