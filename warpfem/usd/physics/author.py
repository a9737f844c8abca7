"""Writes what a scene is into the file of its motion, in the words that a stage is read by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

from warpfem.boundary import Box, BoxWalls, Obstacle, Plane, Sphere
from warpfem.usd.physics import tokens
from warpfem.usd.prims import PHYSICS

_MOST_SUBSETS = 64
"""Different materials of one body that are written out."""


@dataclass(frozen=True, eq=False)
class BodyPhysics:
    """The physics of a body.

    Attributes:
        model: the name of its material's model; "" for one that E and nu do not determine.
        materials: (m, 3) Young's modulus [Pa], Poisson's ratio and density [kg/m^3] per cell, or (1, 3) for all cells;
            nan for what there is not.
        pins: points that are held in all directions.
        lacking: what the body has that a stage has no words for, for people; "" if nothing.
    """

    model: str
    materials: np.ndarray
    pins: np.ndarray
    lacking: str


@dataclass(frozen=True, eq=False)
class ScenePhysics:
    """The physics of a scene.

    Attributes:
        gravity: acceleration [m/s^2], ``None`` for none.
        damping: mass-proportional damping [1/s].
        bodies: one for each body.
    """

    gravity: Sequence[float] | None
    damping: float
    bodies: Sequence[BodyPhysics]


def author_physics(
    stage: Usd.Stage, physics: ScenePhysics, meshes: Sequence[Sdf.Path], obstacles: Sequence[Obstacle]
) -> None:
    """Authors a physics scene, the materials and the schemas of the bodies, and colliders for the obstacles.

    All new prims are under ``/World/Physics``; the colliders are of purpose guide, beside the meshes that are seen.

    Args:
        stage: the stage, with its bodies at rest.
        physics: what to author.
        meshes: the ``TetMesh`` of each body, whose parent is the body.
        obstacles: the obstacles, in 3D.
    """
    UsdGeom.Scope.Define(stage, PHYSICS)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    _author_scene(stage, physics)
    for path, body in zip(meshes, physics.bodies, strict=True):
        _author_body(stage, path, body)
    singles = [one for own in obstacles for one in (own.planes() if isinstance(own, BoxWalls) else [own])]
    for index, obstacle in enumerate(singles):
        _author_collider(stage, PHYSICS.AppendChild(f"{type(obstacle).__name__}_{index}"), obstacle)


def _author_scene(stage: Usd.Stage, physics: ScenePhysics) -> None:
    scene = UsdPhysics.Scene.Define(stage, PHYSICS.AppendChild("Scene"))
    gravity = np.zeros(3) if physics.gravity is None else np.asarray(physics.gravity, float)
    magnitude = float(np.linalg.norm(gravity))
    scene.CreateGravityMagnitudeAttr(magnitude)
    if magnitude > 0.0:
        scene.CreateGravityDirectionAttr(Gf.Vec3f(*(gravity / magnitude).tolist()))
    if physics.damping:
        scene.GetPrim().CreateAttribute(tokens.DAMPING, Sdf.ValueTypeNames.Double).Set(float(physics.damping))


def _author_body(stage: Usd.Stage, path: Sdf.Path, body: BodyPhysics) -> None:
    mesh = UsdGeom.TetMesh.Get(stage, path)
    prim, owner = mesh.GetPrim(), stage.GetPrimAtPath(path.GetParentPath())
    owner.AddAppliedSchema(tokens.BODY_API)
    prim.AddAppliedSchema(tokens.SIMULATION_API)
    UsdPhysics.CollisionAPI.Apply(prim)
    rest = prim.CreateAttribute(tokens.REST_POINTS, Sdf.ValueTypeNames.Point3fArray)
    rest.Set(mesh.GetPointsAttr().Get())
    if body.lacking:
        owner.CreateAttribute(tokens.NOT_HERE, Sdf.ValueTypeNames.String).Set(body.lacking)

    values, members = np.unique(body.materials, axis=0, return_inverse=True)
    for index, row in enumerate(values[:_MOST_SUBSETS]):
        name = owner.GetName() if len(values) == 1 else f"{owner.GetName()}_{index}"
        material = _material(stage, PHYSICS.AppendChild(name), body.model, *row.tolist())
        if index == 0:
            _bind(prim, material)
            continue
        subset = UsdGeom.Subset.Define(stage, path.AppendChild(f"material_{index}"))
        subset.CreateElementTypeAttr(UsdGeom.Tokens.tetrahedron)
        subset.CreateFamilyNameAttr("physics")
        cells = np.flatnonzero(members.reshape(-1) == index).astype(np.int32)
        subset.CreateIndicesAttr(Vt.IntArray.FromNumpy(cells))
        _bind(subset.GetPrim(), material)
    if len(body.pins):
        _author_pins(stage, path, body.pins)


def too_many_materials(materials: np.ndarray) -> bool:
    """Whether a body's materials are more than are written out."""
    return len(np.unique(materials, axis=0)) > _MOST_SUBSETS


def _material(
    stage: Usd.Stage, path: Sdf.Path, model: str, youngs_modulus: float, poissons_ratio: float, density: float
) -> UsdShade.Material:
    material = UsdShade.Material.Define(stage, path)
    prim = material.GetPrim()
    UsdPhysics.MaterialAPI.Apply(prim).CreateDensityAttr(density)
    prim.AddAppliedSchema(tokens.MATERIAL_API)
    for name, value in ((tokens.YOUNGS_MODULUS, youngs_modulus), (tokens.POISSONS_RATIO, poissons_ratio)):
        if np.isfinite(value):
            prim.CreateAttribute(name, Sdf.ValueTypeNames.Float, False).Set(value)
    if model:
        prim.CreateAttribute(tokens.MODEL, Sdf.ValueTypeNames.Token).Set(model)
    return material


def _bind(prim: Usd.Prim, material: UsdShade.Material) -> None:
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material, materialPurpose="physics")


def _author_pins(stage: Usd.Stage, mesh: Sdf.Path, pins: np.ndarray) -> None:
    """Attaches points to the body's own frame, which stands still."""
    body = mesh.GetParentPath()
    prim = stage.DefinePrim(PHYSICS.AppendChild(f"{body.name}_pins"), tokens.ATTACHMENT)
    prim.CreateRelationship("physics:src0", False).SetTargets([mesh])
    prim.CreateRelationship("physics:src1", False).SetTargets([body])
    for name, kind in (("physics:type0", "point"), ("physics:type1", "xform")):
        prim.CreateAttribute(name, Sdf.ValueTypeNames.Token, False, Sdf.VariabilityUniform).Set(kind)
    points = np.array(UsdGeom.TetMesh.Get(stage, mesh).GetPointsAttr().Get())[pins]
    indices = prim.CreateAttribute("physics:indices0", Sdf.ValueTypeNames.IntArray, False)
    indices.Set(Vt.IntArray.FromNumpy(pins.astype(np.int32)))
    places = prim.CreateAttribute("physics:coords1", Sdf.ValueTypeNames.Vector3fArray, False)
    places.Set(Vt.Vec3fArray.FromNumpy(points))


def _author_collider(stage: Usd.Stage, path: Sdf.Path, obstacle: Plane | Sphere | Box) -> None:
    frame = np.eye(4)
    shape: UsdGeom.Gprim
    if isinstance(obstacle, Plane):
        shape = UsdGeom.Plane.Define(stage, path)  # normal to z
        normal = np.array(obstacle.normal)
        across = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
        across /= np.linalg.norm(across)
        frame[:3, :3] = across, np.cross(normal, across), normal
        frame[3, :3] = obstacle.point
    elif isinstance(obstacle, Sphere):
        shape = UsdGeom.Sphere.Define(stage, path)
        shape.CreateRadiusAttr(obstacle.radius)
        frame[3, :3] = obstacle.center
    else:
        shape = UsdGeom.Cube.Define(stage, path)
        shape.CreateSizeAttr(1.0)
        frame[:3, :3] = np.array(obstacle.size)[:, None] * np.array(obstacle.axes)
        frame[3, :3] = obstacle.center
    prim = shape.GetPrim()
    shape.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(shape, Usd.TimeCode.Default()))
    shape.AddTransformOp().Set(Gf.Matrix4d(frame))
    shape.CreatePurposeAttr(UsdGeom.Tokens.guide)
    UsdPhysics.CollisionAPI.Apply(prim)
    if obstacle.friction > 0.0:
        material = UsdShade.Material.Define(stage, PHYSICS.AppendChild(f"{path.name}_friction"))
        friction = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
        friction.CreateDynamicFrictionAttr(obstacle.friction)
        friction.CreateStaticFrictionAttr(obstacle.friction)
        _bind(prim, material)
    if obstacle.stiffness is not None:
        prim.CreateAttribute(tokens.STIFFNESS, Sdf.ValueTypeNames.Double).Set(float(obstacle.stiffness))
