"""What warpfem makes of the tetrahedra of a Newton model: a scene, the particle of each point, and its mass."""

import warnings
from dataclasses import dataclass

import newton
import numpy as np
import warp as wp

from warpfem.boundary import Box, Obstacle, Pin, Plane, Sphere
from warpfem.errors import MeshError, SceneError
from warpfem.materials import HookeanMaterial
from warpfem.mesh import Mesh
from warpfem.moduli import Parameter
from warpfem.scene import Body, Scene
from warpfem.solvers.base import Solver

REST_TOLERANCE = 1e-3
"""Largest strain of the model's first positions against the rest shapes of its tetrahedra: far above rounding."""

ROUNDING = 1e-6
"""The part by which densities may differ that are meant to be one: masses have float32."""


@dataclass(frozen=True, eq=False)
class NewtonSolid:
    """The tetrahedra of a Newton model as a scene, a body for each connected part.

    Attributes:
        scene: the bodies at rest, held where their particles are, with the obstacles of the model.
        particles: the particle of each point, (point_count,) int32.
        masses: the mass of each point [kg], (point_count,) float64; at held points what the neighbours suggest.
    """

    scene: Scene
    particles: np.ndarray
    masses: np.ndarray


def read_solid(model: newton.Model, solver: Solver, material: type[HookeanMaterial]) -> NewtonSolid:
    """Makes a scene of the tetrahedra of a Newton model, and warns of what it leaves out.

    Raises:
        SceneError: there are no tetrahedra, or the model's positions are not their rest shape, or none is free.
        MeshError: the tetrahedra are no mesh that warpfem can take.
        MaterialError: k_mu and k_lambda of a tetrahedron are those of no stable solid.
    """
    if not model.tet_count:
        raise SceneError(
            "the Newton model has no tetrahedra: add some by add_soft_grid, add_soft_mesh or add_tetrahedron"
        )
    if not (isinstance(material, type) and issubclass(material, HookeanMaterial)):
        raise SceneError(f"material must be a class such as wf.StableNeoHookean, not {material!r}")
    tets = model.tet_indices.numpy().reshape(-1, 4)
    positions = model.particle_q.numpy().astype(np.float64)
    _require_rest_shape(positions, tets, model.tet_poses.numpy())
    mass = model.particle_mass.numpy().astype(np.float64)
    active = model.particle_flags.numpy() & int(newton.ParticleFlags.ACTIVE) != 0
    held = (mass == 0.0) | ~active
    k_mu, k_lambda = model.tet_materials.numpy().astype(np.float64)[:, :2].T
    bodies, particles, masses = [], [], []
    for number, own in enumerate(_connected(tets, len(positions))):
        name = f"solid_{number}"
        used = np.unique(tets[own])
        try:
            mesh = Mesh(positions[used], np.searchsorted(used, tets[own]).astype(np.int32))
        except MeshError as error:
            raise MeshError(f"{name} of the Newton model, tetrahedra from {own[0]} on: {error}") from None
        densities, filled = _densities(mesh, mass[used], held[used], name)
        supports = [Pin(np.flatnonzero(held[used]))] if held[used].any() else []
        law = material(mu=_plain(k_mu[own]), lam=_plain(k_lambda[own]))
        bodies.append(Body(name, mesh, law, density=_plain(densities), supports=supports))
        particles.append(used)
        masses.append(filled)
    gravity = tuple(float(g) for g in model.gravity.numpy()[0])
    scene = Scene(bodies, solver, gravity=gravity, obstacles=_obstacles(model))
    chosen = np.concatenate(particles).astype(np.int32)
    _warn_of_omissions(model, len(chosen))
    return NewtonSolid(scene, chosen, np.concatenate(masses))


def _plain(values: np.ndarray) -> Parameter:
    """One number where all are the same, which takes less memory."""
    return float(values[0]) if np.ptp(values) == 0.0 else values


def _require_rest_shape(positions: np.ndarray, tets: np.ndarray, inverse_shapes: np.ndarray) -> None:
    """Raises SceneError unless the positions are the rest shape of each tetrahedron, up to a turn of the whole."""
    edges = (positions[tets[:, 1:]] - positions[tets[:, :1]]).transpose(0, 2, 1)
    F = edges @ inverse_shapes
    strain = np.abs(F.transpose(0, 2, 1) @ F - np.eye(3)).max(axis=(1, 2))
    bad = ~(strain <= REST_TOLERANCE)
    if bad.any():
        raise SceneError(
            f"tetrahedron {int(np.argmax(bad))} of the Newton model ({int(bad.sum())} in all) is strained by "
            f"{strain[np.argmax(bad)]:.2g} at model.particle_q: warpfem takes these positions for the rest shape. "
            "Deform the state, not the model"
        )


def _connected(tets: np.ndarray, particle_count: int) -> list[np.ndarray]:
    """The tetrahedra of each connected part, in the order of their first."""
    label = np.arange(particle_count)
    while True:
        least = label[tets].min(axis=1)
        lower = label.copy()
        np.minimum.at(lower, tets, least[:, None])
        lower = lower[lower]
        if (lower == label).all():
            break
        label = lower
    of_tet = label[tets[:, 0]]
    order = np.argsort(of_tet, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(of_tet[order])) + 1)
    return sorted(parts, key=lambda part: int(part[0]))


def _densities(mesh: Mesh, mass: np.ndarray, held: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Densities of the cells that give no point more than its mass, and the masses with those of held points filled.

    So the stability limit of explicit steps, which is that of the cells, holds for masses that no density gives.
    """
    shares = np.repeat(mesh.cell_volumes / 4.0, 4)
    volume = np.bincount(mesh.cells.ravel(), shares, mesh.point_count)
    bad = ~held & ~(np.isfinite(mass) & (mass > 0.0))
    if bad.any():
        raise SceneError(f"{name} of the Newton model: a particle has the mass {mass[np.argmax(bad)]:g} kg")
    if held.all():
        raise SceneError(f"{name} of the Newton model: all its particles are held (without mass, or not active)")
    mean = mass[~held].sum() / volume[~held].sum()
    density = np.where(held, mean, mass / volume)
    least = np.where(held, np.inf, density)[mesh.cells].min(axis=1)
    least = np.where(np.isfinite(least), least, mean)
    if np.ptp(least) <= ROUNDING * mean:
        least[:] = least.min()
    return least, np.where(held, mean * volume, mass)


def _obstacles(model: newton.Model) -> list[Obstacle]:
    """The planes, spheres and boxes that do not move, each once; warns of other shapes that particles would touch."""
    if not model.shape_count:
        return []
    flags, kinds, bodies = model.shape_flags.numpy(), model.shape_type.numpy(), model.shape_body.numpy()
    in_world = model.shape_world.numpy()
    worlds: dict[Obstacle, set[int]] = {}
    for shape in np.flatnonzero(flags & int(newton.ShapeFlags.COLLIDE_PARTICLES)).tolist():
        kind, label = newton.GeoType(int(kinds[shape])), model.shape_label[shape]
        obstacle = _obstacle(model, shape, kind) if bodies[shape] < 0 else None
        if obstacle is None:
            moves = " of a body" if bodies[shape] >= 0 else ""
            _warn(f"shape '{label}' is a {kind.name.lower()}{moves}: solids pass through it")
            continue
        if kind == newton.GeoType.PLANE and model.shape_scale.numpy()[shape, :2].any():
            _warn(f"shape '{label}' is a plane with edges: it is taken for an infinite one")
        worlds.setdefault(obstacle, set()).add(int(in_world[shape]))
    single = [obstacle for obstacle, own in worlds.items() if -1 not in own and len(own) < model.world_count]
    if single:
        _warn(f"obstacles of some worlds are felt in all ({len(single)} in all)")
    return list(worlds)


def _obstacle(model: newton.Model, shape: int, kind: newton.GeoType) -> Obstacle | None:
    """The obstacle that a shape is, if there is such a one."""
    place, scale = model.shape_transform.numpy()[shape].tolist(), model.shape_scale.numpy()[shape].tolist()
    center, turn = tuple(place[:3]), wp.quat(*place[3:])
    axes = [np.array(wp.quat_rotate(turn, wp.vec3(*unit))).tolist() for unit in np.eye(3)]
    friction = float(np.sqrt(model.soft_contact_mu * model.shape_material_mu.numpy()[shape]))
    if kind == newton.GeoType.PLANE:
        return Plane(center, axes[2], friction=friction)
    if kind == newton.GeoType.SPHERE:
        return Sphere(center, scale[0], friction=friction)
    if kind == newton.GeoType.BOX:
        return Box(center, [2.0 * half for half in scale], axes, friction=friction)
    return None


def _warn_of_omissions(model: newton.Model, point_count: int) -> None:
    """Warns of what acts in the model besides tetrahedra and obstacles."""
    tets, triangles = model.tet_materials.numpy(), _rows(model.tri_materials)
    parts = [
        (_count(tets[:, 2]), "the damping of tetrahedra (k_damp) is left out"),
        (_count(_rows(model.tet_activations)), "the activation of tetrahedra is left out"),
        (_count(triangles), "the stiffness, damping, drag and lift of triangles are left out"),
        (_count(_rows(model.edge_bending_properties)), "the bending stiffness of edges is left out"),
        (model.spring_count, "springs are left out"),
        (model.attachment_particle_body_count, "attachments of particles to bodies are left out"),
        (model.body_count, "rigid bodies stay where they are"),
        (model.particle_count - point_count, "particles of no tetrahedron stay where they are"),
    ]
    for number, what in parts:
        if number:
            _warn(f"{what} ({number} in all)")


def _rows(values: wp.array | None) -> np.ndarray:
    return np.zeros(0) if values is None else values.numpy()


def _count(values: np.ndarray) -> int:
    """How many rows are not zero."""
    return int(np.count_nonzero(values if values.ndim < 2 else values.any(axis=1)))


def _warn(what: str) -> None:
    warnings.warn(f"Newton model: {what}", stacklevel=5)
