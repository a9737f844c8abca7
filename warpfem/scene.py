"""What a person writes: bodies, what acts on them, and how to run the simulation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, TypeAlias, TypeVar

import numpy as np

from warpfem.boundary import Load, Obstacle, Pin, PointForce, PrescribedMotion, Support, Traction, Vector, is_number
from warpfem.errors import SceneError, source_of, user_code
from warpfem.materials import HookeanMaterial, Material
from warpfem.mesh import Mesh

if TYPE_CHECKING:
    from warpfem.motion import Motion
    from warpfem.solvers.base import Solver

PointField: TypeAlias = Vector | np.ndarray | Callable[[np.ndarray], np.ndarray]
"""One vector for all points, an array (point_count, dim), or a function of the rest points."""

Term = TypeVar("Term")

ELEMENTS = ("linear", "quadratic", "averaged")
"""What a body's cells can be."""

LEAST_AVERAGED_NU = 0.01
"""Below this there is nothing to average, and in the end nothing to divide by."""

_MOST = 1e12
"""The largest number of frames per second, time step [s] or damping [1/s]: what is beyond overflows in float32."""


def _require_list(name: str, value: object) -> None:
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise SceneError(f"{name} must be a list, not {value!r}")


@dataclass(frozen=True, eq=False)
class Body:
    """An elastic solid.

    Attributes:
        name: unique in its scene; names the body's prim in USD.
        mesh: rest shape [m].
        material: hyperelastic material.
        density: mass per rest volume [kg/m^3], > 0; a number, or an array (cell_count,). In 2D bodies are
            1 m thick.
        supports: pins and prescribed motions.
        loads: point forces and tractions.
        element: "linear", "quadratic" or "averaged"; ``None`` takes the mesh as it is. "quadratic" gives a linear mesh
            midpoints (:meth:`Mesh.quadratic`), and :attr:`mesh` is then the quadratic one, to which arrays per point
            refer. Points that pins, motions and tractions list by number gain the midpoints between them, as named
            sets do. Several times the cost, for an accuracy that linear cells reach at a hundred times the cost or
            never. "averaged" cells are linear and share their volume change with some neighbours: about as accurate
            for nu near 0.5 as linear ones are for nu = 0.3.
        displacement: initial displacement [m]: one vector for all points, an array (point_count, dim), or a
            function of the rest points (point_count, dim) that returns either; ``None`` starts at rest shape.
        velocity: initial velocity [m/s], likewise; ``None`` starts at rest.
    """

    name: str
    mesh: Mesh
    material: Material
    density: float | np.ndarray = 1000.0
    supports: Sequence[Support] = ()
    loads: Sequence[Load] = ()
    element: Literal["linear", "quadratic", "averaged"] | None = None
    displacement: PointField | None = None
    velocity: PointField | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip():
            raise SceneError(f"a body needs a name, not {self.name!r}")
        if not isinstance(self.mesh, Mesh):
            raise SceneError(f"body '{self.name}': mesh must be a warpfem.Mesh, not {type(self.mesh).__name__}")
        if not isinstance(self.material, Material):
            raise SceneError(
                f"body '{self.name}': material must be a warpfem material, for example "
                f"StableNeoHookean(E=1e5, nu=0.45), not {self.material!r}"
            )
        for name in ("supports", "loads"):
            _require_list(f"body '{self.name}': {name}", getattr(self, name))
        self._choose_element()
        try:
            density = np.array(self.density, dtype=np.float64)  # a copy, as of all that a caller may change later
        except (TypeError, ValueError, OverflowError):
            raise SceneError(f"body '{self.name}': density must be a number, not {self.density!r}") from None
        if density.ndim > 1 or (density.ndim == 1 and len(density) != self.mesh.cell_count):
            raise SceneError(
                f"body '{self.name}': density has shape {density.shape}, but the mesh has {self.mesh.cell_count} cells"
            )
        bad = ~(np.isfinite(density) & (density > 0.0))
        if bad.any():
            where = f" in cell {int(np.argmax(bad))} ({int(bad.sum())} in all)" if density.ndim else ""
            raise SceneError(
                f"body '{self.name}': density must be finite and > 0, not {density.flat[np.argmax(bad)]:g}{where}"
            )
        object.__setattr__(self, "density", density if density.ndim else float(density))
        try:
            self.material.parameter_rows(self.mesh.cell_count)
        except ValueError as error:
            raise SceneError(f"body '{self.name}': {error}") from None

    def _choose_element(self) -> None:
        order = self.mesh.order
        if self.element is None:
            object.__setattr__(self, "element", ELEMENTS[order - 1])
        elif not isinstance(self.element, str) or self.element not in ELEMENTS:
            known = ", ".join(map(repr, ELEMENTS[:-1])) + f" or {ELEMENTS[-1]!r}"
            raise SceneError(f"body '{self.name}': element must be {known}, not {self.element!r}")
        elif self.element == "quadratic":
            if order == 1:
                for name in ("supports", "loads"):
                    object.__setattr__(self, name, [self._with_midpoints(term) for term in getattr(self, name)])
                object.__setattr__(self, "mesh", self.mesh.quadratic())
        elif order == 2:
            raise SceneError(
                f"body '{self.name}': element='{self.element}', but the mesh is quadratic: leave it out, or give the "
                "linear mesh"
            )
        if self.element == "averaged":
            self._require_averageable()

    def _require_averageable(self) -> None:
        """Raises SceneError unless the material has a volumetric part for cells to average."""
        material = self.material
        if not isinstance(material, HookeanMaterial) or material.constitutive.volumetric is None:
            raise SceneError(
                f"body '{self.name}': element='averaged' averages the volumetric part of the energy, which "
                f"{type(material).__name__} does not state: take element='quadratic'"
            )
        values = np.atleast_1d(np.asarray(material.nu, dtype=np.float64))
        bad = values < LEAST_AVERAGED_NU
        if bad.any():
            nu = values[np.argmax(bad)]
            where = f" of cell {int(np.argmax(bad))} ({int(bad.sum())} in all)" if len(bad) > 1 else ""
            raise SceneError(
                f"body '{self.name}': element='averaged' is for nu >= {LEAST_AVERAGED_NU:g}, and the nu{where} is "
                f"{nu:g}: take element='linear', which does not lock there"
            )

    def _with_midpoints(self, term: Term) -> Term:
        """The term with the midpoints between the points of the linear mesh that it lists; sets have theirs."""
        if not isinstance(term, Pin | PrescribedMotion | Traction) or isinstance(term.points, str):
            return term
        try:
            members = self.mesh.select_points(term.points)
        except ValueError:
            return term  # refused where its body is named
        return replace(term, points=self.mesh.with_midpoints(members))

    def refined(self) -> Body:
        """The body with each of its cells divided into 4 (2D) or 8 (3D).

        Forces on points stay where they are, and initial values that are arrays are interpolated linearly.
        """
        mesh = self.mesh
        parts = len(mesh.quadratic().shape.parts)

        def per_point(value: PointField | None) -> PointField | None:
            if value is None or callable(value):
                return value
            array = np.asarray(value)
            if array.ndim == 1:
                return array
            edges = mesh.edges if mesh.order == 1 else mesh.refined().edges  # those that gain a midpoint
            return np.concatenate([array, array[edges].mean(axis=1)])

        def term(own: Term) -> Term:
            if isinstance(own, PointForce):  # on the same points, whatever their set gains
                return replace(own, points=mesh.select_points(own.points))
            return own if mesh.order == 2 else self._with_midpoints(own)

        return replace(
            self,
            mesh=mesh.refined(),
            material=self.material.repeated(parts),
            density=np.repeat(self.density, parts) if isinstance(self.density, np.ndarray) else self.density,
            supports=[term(own) for own in self.supports],
            loads=[term(own) for own in self.loads],
            displacement=per_point(self.displacement),
            velocity=per_point(self.velocity),
        )

    def initial_displacement(self) -> np.ndarray:
        """Initial displacement, (point_count, dim) float64 [m]."""
        return self._point_field("displacement", self.displacement)

    def initial_velocity(self) -> np.ndarray:
        """Initial velocity, (point_count, dim) float64 [m/s]."""
        return self._point_field("velocity", self.velocity)

    def _point_field(self, name: str, value: PointField | None) -> np.ndarray:
        shape = self.mesh.points.shape
        if value is None:
            return np.zeros(shape)
        if callable(value):
            with user_code(f"body '{self.name}', initial {name}", source_of(value)):
                value = value(self.mesh.points.copy())
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise SceneError(f"body '{self.name}': initial {name} must be numbers, not {value!r}") from None
        if array.shape not in (shape, shape[1:]):
            raise SceneError(
                f"body '{self.name}': initial {name} has shape {array.shape}; expected {shape} or {shape[1:]}"
            )
        bad = ~np.isfinite(array)
        if bad.any():
            raise SceneError(
                f"body '{self.name}': initial {name} is not finite at index {int(np.argmax(bad.any(axis=-1)))}"
            )
        return np.array(np.broadcast_to(array, shape))


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that a simulation needs to know.

    Bodies touch obstacles only: they pass through each other and through themselves.

    Attributes:
        bodies: at least one; all of the same dimension.
        solver: how time is stepped, for example ``BackwardEuler()``.
        dt: time step [s]; it is shortened to divide the frame interval. ``"auto"`` takes a safe part of the
            stability limit for explicit solvers, what its error target allows for a solver that has one, and the frame
            interval for other implicit ones, which is too long to follow motion that is not much slower.
        gravity: acceleration [m/s^2]; ``None`` for none.
        obstacles: planes, spheres, boxes and box walls.
        damping: mass-proportional damping alpha [1/s], >= 0: the force -alpha m v.
        fps: frames per second of simulated time, > 0.
        frames: frames to simulate after the initial one, >= 0.
        up_axis: "Y" or "Z": which way is up in the USD file.
        color_by: "von_mises" or "jacobian": the quantity that colours the bodies in the USD file.
        quantities: numbers of the motion that matter, by name, each a function of a :class:`warpfem.motion.Motion`
            (``warpfem.quantities`` has the usual ones): ``warpfem trade`` measures their errors, and a plain run does
            not compute them.
    """

    bodies: Sequence[Body]
    solver: Solver
    dt: float | Literal["auto"] = "auto"
    gravity: Vector | None = None
    obstacles: Sequence[Obstacle] = ()
    damping: float = 0.0
    fps: float = 24.0
    frames: int = 48
    up_axis: Literal["Y", "Z"] = "Y"
    color_by: Literal["von_mises", "jacobian"] = "von_mises"
    quantities: Mapping[str, Callable[[Motion], float]] = field(default_factory=dict)
    dim: int = field(init=False)

    def __post_init__(self) -> None:
        is_list = isinstance(self.bodies, Sequence) and len(self.bodies) > 0
        if not is_list or not all(isinstance(body, Body) for body in self.bodies):
            raise SceneError("a scene needs a list of at least one warpfem.Body")
        dims = {body.mesh.dim for body in self.bodies}
        if len(dims) != 1:
            listed = ", ".join(f"'{body.name}' is {body.mesh.dim}D" for body in self.bodies)
            raise SceneError(f"all bodies of a scene must be 2D, or all 3D: {listed}")
        object.__setattr__(self, "dim", dims.pop())
        names = [body.name for body in self.bodies]
        for name in names:
            if names.count(name) > 1:
                raise SceneError(f"{names.count(name)} bodies are named '{name}': give each its own name")
        if isinstance(self.solver, type) or not callable(getattr(self.solver, "stepper", None)):
            hint = "; StaticEquilibrium takes no steps: see `warpfem static`" if hasattr(self.solver, "solve") else ""
            raise SceneError(f"solver must be a warpfem solver, for example BackwardEuler(), not {self.solver!r}{hint}")
        self._check_number("fps", self.fps, positive=True)
        self._check_number("damping", self.damping)
        if not isinstance(self.dt, str) or self.dt != "auto":
            self._check_number("dt", self.dt, positive=True)
        if isinstance(self.frames, bool) or not isinstance(self.frames, (int, np.integer)) or self.frames < 0:
            raise SceneError(f"frames must be an integer >= 0, not {self.frames!r}")
        if not isinstance(self.up_axis, str) or self.up_axis not in ("Y", "Z"):
            raise SceneError(f"up_axis must be 'Y' or 'Z', not {self.up_axis!r}")
        if not isinstance(self.color_by, str) or self.color_by not in ("von_mises", "jacobian"):
            raise SceneError(f"color_by must be 'von_mises' or 'jacobian', not {self.color_by!r}")
        if self.gravity is not None:
            self._check_vector("gravity", self.gravity)
        _require_list("obstacles", self.obstacles)
        for obstacle in self.obstacles:
            if not isinstance(obstacle, Obstacle):
                raise SceneError(f"an obstacle must be a Plane, Sphere, Box or BoxWalls, not {obstacle!r}")
            vector = getattr(obstacle, "point", getattr(obstacle, "center", getattr(obstacle, "lower", ())))
            self._check_vector(f"{type(obstacle).__name__}: its place", vector)
        self._check_quantities()

    def _check_quantities(self) -> None:
        if not isinstance(self.quantities, Mapping):
            raise SceneError(f"quantities must be a dict from names to functions, not {self.quantities!r}")
        for name, quantity in self.quantities.items():
            if not isinstance(name, str) or not name.strip() or not callable(quantity):
                raise SceneError(
                    f"quantities must map names to functions of a motion, such as "
                    f"quantities.final_displacement('body', at=(0, 0, 0), axis=1), not {name!r} to {quantity!r}"
                )

    def _check_number(self, name: str, value: object, positive: bool = False) -> None:
        if not is_number(value) or value < 0.0 or (positive and value == 0.0):  # type: ignore[operator]
            raise SceneError(f"{name} must be a finite number {'> 0' if positive else '>= 0'}, not {value!r}")
        if value > _MOST or (positive and value * _MOST < 1.0):  # type: ignore[operator]
            raise SceneError(f"{name} must be a number between {1.0 / _MOST:g} and {_MOST:g}, not {value!r}")

    def _check_vector(self, name: str, value: Vector) -> None:
        try:
            vector = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise SceneError(f"{name} must be a vector of {self.dim} numbers, not {value!r}") from None
        if vector.shape != (self.dim,) or not np.isfinite(vector).all():
            raise SceneError(
                f"{name} must be a finite vector of length {self.dim} in a {self.dim}D scene, not {value!r}"
            )
