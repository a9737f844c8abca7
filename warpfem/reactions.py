"""The forces that hold bodies: those of supports and of obstacles on each point, and their sums.

They follow from the balance of each point, m a = f_internal + f_load + f_obstacle - alpha m v + r, where r is what
supports exert.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpfem.boundary import BoxWalls, Obstacle, Support
from warpfem.errors import SimulationError
from warpfem.model import Model, State


@dataclass(frozen=True, eq=False)
class PointForces:
    """Forces of one origin.

    Attributes:
        name: what exerts them.
        points: numbers of the points in the model, (k,) int.
        places: where the points are, (k, dim) float64 [m]; those of linear elasticity, where they are at rest.
        forces: the force on each point, (k, dim) float64 [N] (2D: per metre of thickness, as all here).
    """

    name: str
    points: np.ndarray
    places: np.ndarray
    forces: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """The sum of the forces, (dim,) [N]."""
        return self.forces.sum(axis=0)

    def moment(self, about: np.ndarray | None = None) -> np.ndarray:
        """The sum of their moments.

        Args:
            about: the place (dim,) [m] that they are about; ``None`` for the origin.

        Returns:
            (3,) [N m]; in 2D (1,), about the axis out of the plane.
        """
        arms = self.places if about is None else self.places - np.asarray(about, dtype=np.float64)
        if arms.shape[1] == 2:
            return np.array([np.sum(arms[:, 0] * self.forces[:, 1] - arms[:, 1] * self.forces[:, 0])])
        return np.cross(arms, self.forces).sum(axis=0)


@dataclass(frozen=True, eq=False)
class Reactions:
    """All forces on the bodies of a state from outside. In equilibrium they and their moments sum to zero.

    Attributes:
        supports: those of each support, in the order of the bodies and their supports. What two pins hold together
            counts for the first.
        obstacles: those of each obstacle, in the order of the scene.
        loads: gravity, point forces and tractions.
        inertia: -m a - alpha m v of each point; zero without accelerations.
    """

    supports: tuple[PointForces, ...]
    obstacles: tuple[PointForces, ...]
    loads: PointForces
    inertia: PointForces

    @property
    def parts(self) -> tuple[PointForces, ...]:
        """All of them."""
        return (*self.supports, *self.obstacles, self.loads, self.inertia)

    @property
    def total(self) -> np.ndarray:
        """The sum of all forces, (dim,) [N]: what is unbalanced."""
        return np.sum([part.total for part in self.parts], axis=0)

    def moment(self, about: np.ndarray | None = None) -> np.ndarray:
        """The sum of all moments, as :meth:`PointForces.moment`."""
        return np.sum([part.moment(about) for part in self.parts], axis=0)


def reactions(model: Model, state: State, acceleration: np.ndarray | None = None) -> Reactions:
    """The forces that supports and obstacles exert in a state.

    Without accelerations they are those of a static equilibrium, in which quadratic cells share gravity by shape
    functions; for a state that time steps have brought to rest give accelerations of zero. After a step of
    :class:`BackwardEuler` that was taken whole, ``(state.velocity - velocity_before) / dt`` gives those of that step;
    other schemes put their forces and their velocities at different times.

    Args:
        model: the model.
        state: the state.
        acceleration: of each point, (point_count, dim) [m/s^2].

    Raises:
        SimulationError: an obstacle has friction, which depends on the way to the state and not on the state alone;
            or the accelerations have another shape.
    """
    if model.contact is not None and model.contact.rough:
        raise SimulationError(
            "reactions are not known with friction, which depends on the way to a state: take friction=0"
        )
    shape = (model.point_count, model.dim)
    inertia = np.zeros(shape)
    if acceleration is not None:
        if np.shape(acceleration) != shape:
            raise SimulationError(f"the acceleration must have shape {shape}, not {np.shape(acceleration)}")
        motion = np.asarray(acceleration, dtype=np.float64) + model.scene.damping * state.velocity
        inertia = -model.lumped_mass[:, None] * motion
    loads = model.static_load if acceleration is None else model.dead_load
    load = np.zeros(shape) if loads is None else loads.numpy().astype(np.float64)
    places = model.rest_points + state.displacement
    for body, (points, _) in zip(model.scene.bodies, model.body_slices, strict=True):
        if body.material.constitutive.small_strain:  # whose balance is that of the rest shape
            places[points] = model.rest_points[points]
    obstacles = _obstacle_forces(model, state, places)
    unbalanced = model.internal_force(state) + load + inertia
    for part in obstacles:
        unbalanced[part.points] += part.forces
    everywhere = np.arange(model.point_count)
    return Reactions(
        supports=_support_forces(model, places, -unbalanced),
        obstacles=obstacles,
        loads=PointForces("loads", everywhere, places, load),
        inertia=PointForces("inertia", everywhere, places, inertia),
    )


def _support_forces(model: Model, places: np.ndarray, forces: np.ndarray) -> tuple[PointForces, ...]:
    claimed = np.zeros(forces.shape, dtype=bool)
    result = []
    for body, start in zip(model.scene.bodies, model.point_starts, strict=False):
        for support in body.supports:
            points = start + body.mesh.select_points(support.points)
            axes = range(model.dim) if support.axes is None else np.atleast_1d(support.axes)
            own = np.zeros((len(points), model.dim), dtype=bool)
            own[:, list(axes)] = True
            own &= ~claimed[points]
            claimed[points] |= own
            name = f"body '{body.name}', {_support_name(support)}"
            result.append(PointForces(name, points, places[points], np.where(own, forces[points], 0.0)))
    return tuple(result)


def _support_name(support: Support) -> str:
    where = f"'{support.points}'" if isinstance(support.points, str) else f"of {len(support.points)} points"
    axes = "" if support.axes is None else " along " + "".join("xyz"[axis] for axis in np.atleast_1d(support.axes))
    return f"{type(support).__name__} {where}{axes}"


def _obstacle_forces(model: Model, state: State, places: np.ndarray) -> tuple[PointForces, ...]:
    if model.contact is None:
        return ()
    points = model.contact.surface.host_points
    out = model.zeros()
    result, first = [], 0
    for number, obstacle in enumerate(model.scene.obstacles):
        last = first + (len(obstacle.planes()) if isinstance(obstacle, BoxWalls) else 1)
        out.zero_()
        for part in model.contact.parts[first:last]:
            part.launch_faces("contact_force", [state.u], [out])
        forces = out.numpy()[points].astype(np.float64)
        result.append(PointForces(_obstacle_name(number, obstacle), points, places[points], forces))
        first = last
    return tuple(result)


def _obstacle_name(number: int, obstacle: Obstacle) -> str:
    return f"obstacle {number}, {type(obstacle).__name__}"
