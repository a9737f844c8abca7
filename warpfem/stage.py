"""Scenes out of USD stages that have physics on them, and scenes in the words of such a stage."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpfem.boundary import Load, Pin, Support
from warpfem.errors import WarpfemError
from warpfem.materials import MATERIALS, HookeanMaterial, StableNeoHookean
from warpfem.mesh import Mesh
from warpfem.scene import Body, Scene
from warpfem.solvers import BackwardEuler

if TYPE_CHECKING:
    from warpfem.usd import BodyPhysics, ScenePhysics
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


def stage_files(path: str | Path) -> tuple[str, ...]:
    """The files that a stage is made of.

    Raises:
        SceneError: as :func:`read_stage`.
    """
    from warpfem.usd import read_stage_scene

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they come when the scene is read
        return read_stage_scene(path).files


def physics_of(scene: Scene) -> ScenePhysics | None:
    """What a file says of a scene for :func:`read_stage`; ``None`` in 2D, for which stages have no words."""
    from warpfem.usd import ScenePhysics

    if scene.dim == 2:
        return None
    return ScenePhysics(scene.gravity, scene.damping, [_body_physics(body) for body in scene.bodies])


def _body_physics(body: Body) -> BodyPhysics:
    from warpfem.usd import BodyPhysics, too_many_materials

    material, lacking = body.material, []
    known = isinstance(material, HookeanMaterial) and MATERIALS.get(material.name) is type(material)
    moduli = (material.E, material.nu) if isinstance(material, HookeanMaterial) else (np.nan, np.nan)
    if not known:
        lacking.append(f"the material {type(material).__name__}")
    columns = np.broadcast_arrays(*(np.asarray(own, float) for own in (*moduli, body.density)))
    materials = np.column_stack([np.atleast_1d(own) for own in columns])
    if too_many_materials(materials):
        materials = np.median(materials, axis=0, keepdims=True)
        lacking.append("moduli or densities that differ from cell to cell")
    if body.element != "linear":
        lacking.append(f"{body.element} cells")
    pins = [own for own in body.supports if isinstance(own, Pin) and (own.axes is None or len(set(own.axes)) == 3)]
    lacking += sorted({_plural(own) for own in (*body.supports, *body.loads) if own not in pins})
    held = [body.mesh.select_points(own.points) for own in pins]
    return BodyPhysics(
        material.name if known else "",
        np.repeat(materials, len(body.mesh.shape.parts), axis=0) if len(materials) > 1 else materials,
        np.unique(np.concatenate(held)) if held else np.zeros(0, np.int32),
        ", ".join(lacking),
    )


def _plural(term: Support | Load) -> str:
    return {
        "Pin": "pins of single directions",
        "PrescribedMotion": "prescribed motions",
        "PointForce": "point forces",
        "Traction": "tractions",
    }[type(term).__name__]


@contextmanager
def _naming(where: str) -> Iterator[None]:
    """Says which prim it is that is wrong."""
    try:
        yield
    except WarpfemError as error:
        raise type(error)(f"{where}: {error}") from error
