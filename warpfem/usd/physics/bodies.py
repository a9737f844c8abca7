"""The volume deformables of a stage."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from pxr import Usd, UsdGeom, UsdPhysics, Vt

from warpfem.usd.physics import tokens
from warpfem.usd.physics.data import Follower, StageBody
from warpfem.usd.physics.view import StageView, applied, to_metres


def read_bodies(view: StageView, pins: dict[str, np.ndarray]) -> tuple[StageBody, ...]:
    """The deformables that can be simulated; the others are warned of.

    Args:
        view: the stage.
        pins: points that are held, by the path of the prim with the tetrahedra.

    Raises:
        SceneError: one of them is broken.
    """
    bodies: list[StageBody] = []
    owners: set[str] = set()
    for prim in view.prims:
        if tokens.SIMULATION_API not in applied(prim):
            continue
        owner = body_prim(prim)
        reason = _reason_to_skip(view, prim, owner, owners)
        if reason:
            view.warn(prim, f"is not simulated: {reason}")
            continue
        owners.add(str(owner.GetPath()))
        name = _unique(owner.GetName(), {body.name for body in bodies})
        bodies.append(_body(view, prim, owner, name, pins.get(str(prim.GetPath()), np.zeros(0, np.int32))))
    return tuple(bodies)


def body_prim(prim: Usd.Prim) -> Usd.Prim:
    """The prim that governs a simulation mesh: the nearest deformable body above, or the mesh itself if there is none.

    The proposal wants it on the mesh or its parent; one that is higher up can mean nothing else.
    """
    above = prim
    while above and not above.IsPseudoRoot() and not above.HasAPI(UsdPhysics.RigidBodyAPI):
        if tokens.BODY_API in applied(above):
            return above
        above = above.GetParent()
    return prim


def _unique(name: str, taken: set[str]) -> str:
    count, unique = 1, name
    while unique in taken:
        count += 1
        unique = f"{name}_{count}"
    return unique


def _reason_to_skip(view: StageView, prim: Usd.Prim, owner: Usd.Prim, owners: set[str]) -> str:
    if not prim.IsA(UsdGeom.TetMesh):
        return f"a volume deformable must be a TetMesh, not a {prim.GetTypeName() or 'prim without a type'}"
    if view.is_prototype(prim):
        return "it is a prototype of a PointInstancer"
    if str(owner.GetPath()) in owners:
        return f"{owner.GetPath()} has another simulation mesh"
    if owner.HasAPI(UsdPhysics.RigidBodyAPI):
        return f"{owner.GetPath()} is a rigid body, too"
    if not view.switch(owner, "physics:bodyEnabled", True):
        return "physics:bodyEnabled is false"
    if view.switch(owner, "physics:kinematicEnabled", False):
        return "physics:kinematicEnabled is true, and warpfem has no kinematic deformables"
    if view.is_carried(prim):
        return "its transform, or one above it, is animated"
    return ""


def _body(view: StageView, prim: Usd.Prim, owner: Usd.Prim, name: str, pins: np.ndarray) -> StageBody:
    place = view.place(prim)
    cells = view.rows(prim, "tetVertexIndices", 4)
    if cells is None or len(cells) == 0:
        raise view.error(prim, "it has no tetrahedra")
    count = len(place.points)
    bad = np.flatnonzero(((cells < 0) | (cells >= count)).any(axis=1))
    if len(bad):
        raise view.error(
            prim,
            f"{len(bad)} of its {len(cells)} tetrahedra refer to points that it has not, the first one is {bad[0]}",
        )
    used, own_cells = np.unique(cells, return_inverse=True)
    rest = _rest_points(view, prim, cells, place.points)
    velocities = view.rows(prim, "velocities")
    if velocities is not None and len(velocities) not in (0, count):
        view.warn(prim, f"its {len(velocities)} velocities are left out: it has {count} points")
        velocities = None
    if velocities is None or len(velocities) == 0:
        velocities = np.zeros((count, 3))
    rest_points = to_metres(rest, place)[used]
    corners = rest_points[own_cells.reshape(-1, 4)]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
    youngs_modulus, poissons_ratio, density, model = _materials(view, prim, len(cells))
    if view.switch(owner, "physics:startsAsleep", False):
        view.warn(prim, "physics:startsAsleep is left out: it moves from the start")
    lacking = view.value(owner, tokens.NOT_HERE)
    if lacking:
        view.warn(prim, f"the scene that it comes from had {lacking}, which a stage has no words for: it runs without")
    return StageBody(
        name=name,
        place=place,
        used=used,
        cells=own_cells.reshape(-1, 4).astype(np.int32),
        rest_points=rest_points,
        start_points=to_metres(place.points, place)[used],
        velocities=(velocities @ place.to_world[:3, :3])[used],
        bind_points=to_metres(_bind_points(view, prim, count), place)[used],
        youngs_modulus=youngs_modulus,
        poissons_ratio=poissons_ratio,
        density=_density(view, prim, owner, density, float(volumes.sum()), count),
        material=model,
        pins=np.flatnonzero(np.isin(used, pins)).astype(np.int32),
        followers=tuple(_followers(view, prim, owner)),
    )


def _rest_points(view: StageView, prim: Usd.Prim, cells: np.ndarray, points: np.ndarray) -> np.ndarray:
    rest = view.rows(prim, tokens.REST_POINTS)
    if rest is None or len(rest) == 0:
        return points
    own = view.rows(prim, tokens.REST_CELLS, 4)
    if own is not None and len(own) and not np.array_equal(own, cells):
        view.warn(prim, f"{tokens.REST_POINTS} is left out: {tokens.REST_CELLS} connects them in another way")
        return points
    if len(rest) != len(points):
        view.warn(prim, f"{tokens.REST_POINTS} is left out: it has {len(rest)} points, not {len(points)}")
        return points
    return rest


def _bind_points(view: StageView, prim: Usd.Prim, count: int) -> np.ndarray:
    """The positions to which a body and what it carries were fitted: its bind pose, or its points as authored."""
    for name in applied(prim):
        schema, _, instance = name.partition(":")
        prefix = f"physics:deformablePose:{instance}"
        if schema == tokens.POSE_API and "bindPose" in (view.value(prim, f"{prefix}:purposes") or ()):
            points = view.rows(prim, f"{prefix}:points")
            break
    else:
        points = view.default_rows(prim, "points")
    if points is None or len(points) != count:
        raise view.error(prim, f"its bind pose has {0 if points is None else len(points)} points, not {count}")
    return points


# ---- materials


def _materials(
    view: StageView, prim: Usd.Prim, cell_count: int
) -> tuple[float | np.ndarray, float | np.ndarray, float | np.ndarray | None, str]:
    """Young's modulus [Pa], Poisson's ratio, density [kg/m^3] if there is one, and the name of the model."""
    material = view.material(prim)
    values = _moduli(view, prim, material)
    model = (material and view.value(material, tokens.MODEL)) or ""
    subsets = [child for child in prim.GetChildren() if child.IsA(UsdGeom.Subset)]
    bound = [(subset, own) for subset in subsets if (own := view.material(subset)) and own != material]
    if not bound:
        return *values, model
    if values[2] is None:
        values = (*values[:2], tokens.DEFAULT_DENSITY)
    columns = np.tile(np.array(values, float), (cell_count, 1))
    for subset, own in bound:
        indices = np.array(view.value(subset, "indices") or [], np.int64)
        kind = UsdGeom.Subset(subset).GetElementTypeAttr().Get()
        if kind != "tetrahedron" or (len(indices) and not 0 <= indices.min() <= indices.max() < cell_count):
            view.warn(subset, "is left out: it is no set of the mesh's tetrahedra")
            continue
        youngs_modulus, poissons_ratio, density = _moduli(view, subset, own)
        columns[indices] = youngs_modulus, poissons_ratio, tokens.DEFAULT_DENSITY if density is None else density
    return columns[:, 0], columns[:, 1], columns[:, 2], model


def _moduli(view: StageView, prim: Usd.Prim, material: Usd.Prim | None) -> tuple[float, float, float | None]:
    """Those of one material, in SI units, with what the proposal says for values that are not there."""
    youngs_modulus = poissons_ratio = density = None
    if material:
        if tokens.MATERIAL_API in applied(material):
            youngs_modulus = view.number(material, tokens.YOUNGS_MODULUS)
            poissons_ratio = view.number(material, tokens.POISSONS_RATIO)
        density = view.number(material, tokens.DENSITY)
    if youngs_modulus is None or youngs_modulus == -np.inf:
        view.warn(
            prim,
            f"no material with {tokens.MATERIAL_API} gives it a Young's modulus: {tokens.DEFAULT_YOUNGS_MODULUS:g} Pa "
            "is taken, as the proposal says",
        )
        youngs_modulus = tokens.DEFAULT_YOUNGS_MODULUS
    else:
        youngs_modulus *= view.mass / view.length
    if density is not None:
        density = density * view.mass / view.length**3 or None  # 0 is no density
    return (
        youngs_modulus,
        tokens.DEFAULT_POISSONS_RATIO if poissons_ratio is None else poissons_ratio,
        density,
    )


def _density(
    view: StageView,
    prim: Usd.Prim,
    owner: Usd.Prim,
    of_material: float | np.ndarray | None,
    volume: float,
    point_count: int,
) -> float | np.ndarray:
    """The density [kg/m^3]: masses win over the body's mass, that over its density, and that over the material's."""
    masses = view.value(prim, tokens.MASSES)
    if masses is not None and len(masses):
        if len(masses) == point_count:
            view.warn(prim, f"{tokens.MASSES} gives the mass in all, which is spread evenly over the volume")
            return float(np.sum(masses, dtype=float)) * view.mass / volume
        view.warn(prim, f"{tokens.MASSES} is left out: it has {len(masses)} numbers, not {point_count}")
    if tokens.BODY_API in applied(owner):
        mass = view.number(owner, tokens.MASS)
        if mass:
            return mass * view.mass / volume
        density = view.number(owner, tokens.DENSITY)
        if density:
            return density * view.mass / view.length**3
    return tokens.DEFAULT_DENSITY if of_material is None else of_material


# ---- what a body carries along


def _followers(view: StageView, simulation: Usd.Prim, owner: Usd.Prim) -> Iterator[Follower]:
    if owner == simulation:
        return
    for prim in subtree(owner):
        if prim == simulation or not prim.IsA(UsdGeom.PointBased) or tokens.SIMULATION_API in applied(prim):
            continue
        if not prim.IsA(UsdGeom.Mesh):
            view.warn(prim, f"a {prim.GetTypeName()} does not follow the body {owner.GetPath()}, only a Mesh does")
            continue
        if view.is_carried(prim):
            view.warn(prim, f"does not follow the body {owner.GetPath()}: its transform is animated")
            continue
        if view.default_rows(prim, "points") is None:
            continue  # without points there is nothing to see
        yield _follower(view, prim)


def subtree(body: Usd.Prim) -> Iterator[Usd.Prim]:
    """The prims that belong to a body: those below it, but for the bodies nested in it."""
    prims = iter(Usd.PrimRange(body, Usd.TraverseInstanceProxies()))
    for prim in prims:
        if prim != body and (tokens.BODY_API in applied(prim) or prim.HasAPI(UsdPhysics.RigidBodyAPI)):
            prims.PruneChildren()  # type: ignore[attr-defined]
        else:
            yield prim


def _follower(view: StageView, prim: Usd.Prim) -> Follower:
    place = view.place(prim)
    bind_points = to_metres(_bind_points(view, prim, len(place.points)), place)
    mesh = UsdGeom.Mesh(prim)
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("normals")
    is_primvar = bool(primvar) and primvar.HasAuthoredValue()  # which wins over the attribute
    name = "primvars:normals" if is_primvar else "normals"
    normals = view.default_rows(prim, name)
    if normals is None or len(normals) == 0:
        return Follower(place, bind_points)
    indices = np.array(primvar.GetIndices(view.start) or [], np.int32) if is_primvar else np.zeros(0, np.int32)
    if len(indices) and 0 <= indices.min() <= indices.max() < len(normals):
        normals = normals[indices]
    interpolation = primvar.GetInterpolation() if is_primvar else mesh.GetNormalsInterpolation()
    points = np.zeros(0, np.int32)
    if interpolation in ("vertex", "varying"):
        points = np.arange(len(place.points), dtype=np.int32)
    elif interpolation == "faceVarying":
        points = np.array(mesh.GetFaceVertexIndicesAttr().Get(view.start) or Vt.IntArray(), np.int32)
    if len(points) != len(normals) or not 0 <= points.min() <= points.max() < len(place.points):
        view.warn(prim, "its normals stay as they are while it is deformed: they are not one per point or corner")
        return Follower(place, bind_points)
    return Follower(place, bind_points, normals, points, name, len(indices) > 0)


def governed(bodies: Iterable[Usd.Prim]) -> set[str]:
    """The paths of all prims that belong to these bodies."""
    return {str(prim.GetPath()) for body in bodies for prim in subtree(body)}
