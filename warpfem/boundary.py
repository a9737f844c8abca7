"""What acts on a body from outside: supports, loads and obstacles, as a person declares them.

Everything here is plain data without a device. ``supports.py`` and ``contact.py`` carry it out, only for scenes
that have such a term; constant loads become one force per point in ``model.py``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from warpfem.errors import SceneError

PointSelection: TypeAlias = str | Sequence[int] | np.ndarray
"""The name of a point set of the body's mesh, or indices of its points."""

Vector: TypeAlias = Sequence[float]

PERPENDICULAR = 1e-4
"""The largest cosine between two directions that count as perpendicular."""


def is_number(value: object) -> bool:
    """Whether it is one finite number that float64 can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return False
    try:
        return math.isfinite(value)
    except (OverflowError, TypeError):  # an integer of 400 digits, a complex number
        return False


def _vector(owner: str, name: str, value: Vector) -> tuple[float, ...]:
    try:
        vector = tuple(float(component) for component in value)
    except (TypeError, ValueError, OverflowError):
        raise SceneError(f"{owner}: {name} must be a vector of numbers, not {value!r}") from None
    if len(vector) not in (2, 3) or not np.isfinite(vector).all():
        raise SceneError(f"{owner}: {name} must be a finite vector of length 2 or 3, not {value!r}")
    return vector


def _number(owner: str, name: str, value: float, *, above: float | None = None, least: float | None = None):
    if not is_number(value) or (above is not None and value <= above) or (least is not None and value < least):
        domain = f" above {above:g}" if above is not None else f" of at least {least:g}" if least is not None else ""
        raise SceneError(f"{owner}: {name} must be a finite number{domain}, not {value!r}")


@dataclass(frozen=True, eq=False)
class Pin:
    """Holds points at their rest positions.

    Attributes:
        points: name of a point set, or point indices.
        axes: the components held (0 = x, 1 = y, 2 = z); ``None`` holds all. ``axes=(1,)`` is a roller
            that leaves x and z free.
    """

    points: PointSelection
    axes: Sequence[int] | None = None


@dataclass(frozen=True, eq=False)
class PrescribedMotion:
    """Moves points along a given path.

    Attributes:
        points: name of a point set, or point indices.
        motion: ``motion(rest, time) -> positions``; ``rest`` is the (k, dim) float64 array of the points'
            rest positions [m], ``time`` in seconds, the result the (k, dim) positions [m] at that time.
        axes: the components prescribed; ``None`` prescribes all.
    """

    points: PointSelection
    motion: Callable[[np.ndarray, float], np.ndarray]
    axes: Sequence[int] | None = None

    def __post_init__(self) -> None:
        if not callable(self.motion):
            raise SceneError("PrescribedMotion: motion must be a function motion(rest, time) -> positions")


@dataclass(frozen=True, eq=False)
class PointForce:
    """A constant force on each of the points.

    It is meant for single points: the more points a set has, the larger the load, and a quadratic body has midpoints
    too. For a load that is spread over faces take :class:`Traction`.

    Attributes:
        points: name of a point set, or point indices.
        force: force on each point [N] (2D: per metre of thickness, [N/m]).
    """

    points: PointSelection
    force: Vector

    def __post_init__(self) -> None:
        object.__setattr__(self, "force", _vector("PointForce", "force", self.force))


@dataclass(frozen=True, eq=False)
class Traction:
    """A constant nominal traction (force per rest area) on the boundary faces whose points are all selected.

    Attributes:
        points: name of a point set, or point indices.
        traction: force per area of the rest surface [Pa]; dead load: it keeps its direction.
    """

    points: PointSelection
    traction: Vector

    def __post_init__(self) -> None:
        object.__setattr__(self, "traction", _vector("Traction", "traction", self.traction))


@dataclass(frozen=True)
class _Obstacle:
    def _check(self) -> None:
        owner = type(self).__name__
        _number(owner, "friction", self.friction, least=0.0)  # type: ignore[attr-defined]
        if self.stiffness is not None:  # type: ignore[attr-defined]
            _number(owner, "stiffness", self.stiffness, above=0.0)  # type: ignore[attr-defined]


@dataclass(frozen=True)
class Plane(_Obstacle):
    """A fixed half-space: bodies stay on the side that the normal points to.

    Attributes:
        point: any point of the plane [m].
        normal: outward normal, of any length.
        friction: Coulomb coefficient, >= 0.
        stiffness: pressure per depth of penetration [Pa/m]; ``None`` takes the body's P-wave modulus
            over its mean edge length, or what stops the body, from the speed at which it starts and falls towards the
            plane, within a quarter of its thickness, if that is more. Faces that are steep to the plane bear nothing
            down to about the size of a cell, on softer planes further down.
    """

    point: Vector
    normal: Vector
    friction: float = 0.0
    stiffness: float | None = None

    def __post_init__(self) -> None:
        self._check()
        object.__setattr__(self, "point", _vector("Plane", "point", self.point))
        normal = np.array(_vector("Plane", "normal", self.normal))
        if not np.linalg.norm(normal) > 0.0 or len(normal) != len(self.point):
            raise SceneError(f"Plane: normal {tuple(self.normal)} must be non-zero and as long as point {self.point}")
        object.__setattr__(self, "normal", tuple(float(c) for c in normal / np.linalg.norm(normal)))


@dataclass(frozen=True)
class Sphere(_Obstacle):
    """A fixed solid sphere (2D: disc): bodies stay outside.

    Contact is felt by a body's boundary points: a sphere smaller than the faces between them slips through.

    Attributes:
        center: centre [m].
        radius: radius [m], > 0.
        friction: Coulomb coefficient, >= 0.
        stiffness: pressure per depth [Pa/m]; ``None`` as for :class:`Plane`.
    """

    center: Vector
    radius: float
    friction: float = 0.0
    stiffness: float | None = None

    def __post_init__(self) -> None:
        self._check()
        object.__setattr__(self, "center", _vector("Sphere", "center", self.center))
        _number("Sphere", "radius", self.radius, above=0.0)


@dataclass(frozen=True)
class Box(_Obstacle):
    """A fixed solid box (2D: rectangle): bodies stay outside.

    Contact is felt by a body's boundary points: what is smaller than the faces between them, such as a corner of the
    box, slips through. A point that is inside is pushed out through the nearest side.

    Attributes:
        center: centre [m].
        size: full lengths of the edges along ``axes`` [m], > 0.
        axes: directions of the edges, perpendicular to each other and of any length; ``None`` for x, y and z.
        friction: Coulomb coefficient, >= 0.
        stiffness: pressure per depth [Pa/m]; ``None`` as for :class:`Plane`, but a body is stopped within an eighth of
            the box's least size, if that is less.
    """

    center: Vector
    size: Vector
    axes: Sequence[Vector] | None = None
    friction: float = 0.0
    stiffness: float | None = None

    def __post_init__(self) -> None:
        self._check()
        object.__setattr__(self, "center", _vector("Box", "center", self.center))
        object.__setattr__(self, "size", _vector("Box", "size", self.size))
        dim = len(self.center)
        if len(self.size) != dim or min(self.size) <= 0.0:
            raise SceneError(f"Box: size {self.size} must be {dim} numbers above 0, one for each of center")
        given = np.eye(dim).tolist() if self.axes is None else self.axes
        rows = [_vector("Box", "axes", axis) for axis in given] if isinstance(given, Sequence | np.ndarray) else []
        axes = np.array(
            [np.array(row) / max(np.linalg.norm(row), np.finfo(float).tiny) for row in rows if len(row) == dim]
        )
        if len(rows) != dim or axes.shape != (dim, dim) or np.abs(axes @ axes.T - np.eye(dim)).max() > PERPENDICULAR:
            raise SceneError(
                f"Box: axes must be {dim} directions that are perpendicular to each other, not {self.axes!r}"
            )
        object.__setattr__(self, "axes", tuple(map(tuple, axes.tolist())))

    @property
    def shape(self) -> np.ndarray:
        """Rows (dim, dim) [1/m] whose products with a place relative to the centre are within -1..1 inside the box."""
        return np.array(self.axes) / (0.5 * np.array(self.size)[:, None])


@dataclass(frozen=True)
class BoxWalls(_Obstacle):
    """The inner walls of a fixed box: bodies stay inside.

    Attributes:
        lower, upper: opposite corners [m], lower < upper in each component.
        friction: Coulomb coefficient, >= 0.
        stiffness: pressure per depth [Pa/m]; ``None`` as for :class:`Plane`.
    """

    lower: Vector
    upper: Vector
    friction: float = 0.0
    stiffness: float | None = None

    def __post_init__(self) -> None:
        self._check()
        object.__setattr__(self, "lower", _vector("BoxWalls", "lower", self.lower))
        object.__setattr__(self, "upper", _vector("BoxWalls", "upper", self.upper))
        if len(self.lower) != len(self.upper) or not np.less(self.lower, self.upper).all():
            raise SceneError(f"BoxWalls: lower {self.lower} must be below upper {self.upper} in each component")

    def planes(self) -> tuple[Plane, ...]:
        """The walls as half-spaces: 4 in 2D, 6 in 3D."""
        dim = len(self.lower)
        unit = np.eye(dim)
        walls = [(self.lower, unit[axis]) for axis in range(dim)]
        walls += [(self.upper, -unit[axis]) for axis in range(dim)]
        return tuple(Plane(point, normal, self.friction, self.stiffness) for point, normal in walls)


Support: TypeAlias = Pin | PrescribedMotion
Load: TypeAlias = PointForce | Traction
Obstacle: TypeAlias = Plane | Sphere | Box | BoxWalls
