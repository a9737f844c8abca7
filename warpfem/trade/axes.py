"""Axes of a study: what is varied, and which error it bears on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

from warpfem.boundary import is_number
from warpfem.errors import SceneError, WarpfemError
from warpfem.scene import Scene
from warpfem.scene_file import scene_parameters, value_of
from warpfem.solvers.implicit import ImplicitSolver
from warpfem.trade.problem import FORCED, SOLVER_FIELDS, Problem, Setting, require_known

Kind = Literal["space", "time", "algebra", "model"]

SPACE = ("element", "refine")
TIME = ("dt", "solver", "error")
ALGEBRA = ("dtype", *(name for name in SOLVER_FIELDS if name not in TIME))
"""Axes whose names say which error they bear on, if they are not parameters that change the mesh."""

CLEARLY_MORE = 1.5
"""Ratio of cells from which on a mesh is a finer one: generators do not give the same number each time."""


@dataclass(frozen=True)
class Axis:
    """A name and the values that it takes.

    Attributes:
        name: a parameter of the scene, or one of those that change any scene.
        values: as text.
        brought: pairs of a name and a value that come with each of the values, whatever other axes say; empty if none
            brings any.
    """

    name: str
    values: tuple[str, ...]
    brought: tuple[tuple[tuple[str, str], ...], ...] = ()


def parse_axes(texts: Sequence[str], problem: Problem) -> list[Axis]:
    """Axes from texts such as ``cells=4,8,16`` or ``solver=sdirk2,velocity_verlet:dt=auto``.

    Raises:
        SceneError: a text is no axis, or names none that there is.
    """
    parameters = problem.parameter_names()
    axes: list[Axis] = []
    for text in texts:
        name, equals, listed = text.partition("=")
        entries = [_entry(value.strip()) for value in listed.split(",") if value.strip()]
        if not equals or not entries:
            raise SceneError(f"--axis takes NAME=VALUE,VALUE,..., for example --axis cells=4,8,16, not '{text}'")
        for own in [name, *(other for _, brought in entries for other, _ in brought)]:
            if own in ("frames", "fps"):
                raise SceneError(f"{own} is no axis: the motions of all settings are compared frame by frame")
            require_known(own, parameters)
        if name in {axis.name for axis in axes}:
            raise SceneError(f"--axis {name} is given twice: list all values in one")
        values, brought = zip(*dict.fromkeys(entries), strict=True)
        axes.append(Axis(name, values, brought if any(brought) else ()))
    return axes


def _entry(text: str) -> tuple[str, tuple[tuple[str, str], ...]]:
    """A value and what it brings, as in ``velocity_verlet:dt=auto``; a text with other colons is a value."""
    value, *others = text.split(":")
    pairs = tuple((name, brought) for name, equals, brought in (own.partition("=") for own in others) if equals)
    return (value, pairs) if len(pairs) == len(others) else (text, ())


def settings_of(axes: Sequence[Axis], problem: Problem) -> list[Setting]:
    """All combinations of the values, with what these bring, without what its solver does not have, each once.

    Of what two axes bring for one name, that of the later one counts.
    """
    names = [axis.name for axis in axes]
    entries = [zip(axis.values, axis.brought or [()] * len(axis.values), strict=True) for axis in axes]
    settings = []
    for combination in product(*entries):
        plain = Setting(tuple(zip(names, (value for value, _ in combination), strict=True)))
        settings.append(plain.changed(**{name: value for _, brought in combination for name, value in brought}))
    reduced = []
    for setting in settings:
        try:
            reduced.append(problem.applicable(setting))
        except WarpfemError:
            reduced.append(setting)  # it will fail, and say why
    return list(dict.fromkeys(reduced))


@dataclass(frozen=True)
class MeshControl:
    """How the mesh of a problem is made finer: by parameters of the scene, or by dividing all cells.

    Attributes:
        parameters: names and values, as the scene has them by default, of the parameters that set the number of cells.
        sign: 1 if greater values give more cells, -1 if smaller ones do; 0 without parameters.
    """

    parameters: tuple[tuple[str, float], ...] = ()
    sign: int = 0

    @property
    def names(self) -> set[str]:
        """Names of axes that set the mesh."""
        return {name for name, _ in self.parameters} | {"refine"}

    def finer(self, setting: Setting, factor: float) -> Setting | None:
        """The setting with cells smaller by about a factor, or larger by one below 1; ``None`` if there is none."""
        if not self.parameters:
            old = int(setting.get("refine", "0"))
            new = old + round(math.log2(factor))
            return setting.changed(refine=new) if new >= 0 and new != old else None
        changes = {}
        for name, default in self.parameters:
            value = float(setting.get(name, repr(default)))
            scaled = value * factor**self.sign
            if isinstance(default, int):
                new = max(1, round(scaled))
                if new == round(value):
                    return None
                changes[name] = repr(new)
            else:
                changes[name] = f"{scaled:.6g}"
        return setting.changed(**changes)


def mesh_control(problem: Problem) -> MeshControl:
    """Finds out which parameters of the scene set its number of cells: by changing each, which takes as many builds."""
    plain = problem.build(Setting()).scene
    given = dict(problem.parameters)
    numbers: list[tuple[str, float]] = []
    for name, parameter in scene_parameters(problem.path).items():
        value = parameter.default
        if name in given:
            value = value_of(problem.path, name, given[name], value)
        if is_number(value) and value > 0:
            numbers.append((name, value))
    for kind, factor, sign in ((int, 2, 1), (float, 0.5, -1)):
        found = tuple(
            (name, value)
            for name, value in numbers
            if type(value) is kind and _makes_finer(problem, plain, Setting.of(**{name: value * factor}))
        )
        if found:
            return MeshControl(found, sign)
    return MeshControl()


def _makes_finer(problem: Problem, plain: Scene, setting: Setting) -> bool:
    """Whether a setting has more cells in bodies of the same size."""
    try:
        scene = problem.build(setting).scene
    except WarpfemError:
        return False
    if len(scene.bodies) != len(plain.bodies):
        return False
    for body, other in zip(scene.bodies, plain.bodies, strict=True):
        size = other.mesh.bounding_box[1] - other.mesh.bounding_box[0]
        if (abs(body.mesh.bounding_box - other.mesh.bounding_box) > 0.05 * size.max()).any():
            return False
    return _cells(scene) > CLEARLY_MORE * _cells(plain)


def _cells(scene: Scene) -> int:
    return sum(body.mesh.cell_count for body in scene.bodies)


def kind_of(name: str, mesh: MeshControl) -> Kind:
    """Which error an axis bears on; "model" for what changes the problem itself, which no refinement mends."""
    if name in mesh.names:
        return "space"
    name = name.removeprefix(FORCED)
    for kind, names in (("space", SPACE), ("time", TIME), ("algebra", ALGEBRA)):
        if name in names:
            return kind  # type: ignore[return-value]
    return "model"


def default_axes(problem: Problem, mesh: MeshControl) -> list[Axis]:
    """Axes for a scene of which nothing is asked: meshes, elements, time steps and, of implicit ones, schemes."""
    plain = problem.build(Setting()).scene
    axes = []
    if mesh.parameters:
        name, value = mesh.parameters[0]
        values = [value * factor**mesh.sign for factor in (0.5, 1, 2)]
        texts = [repr(max(1, int(v))) if isinstance(value, int) else f"{v:.6g}" for v in values]
        axes.append(Axis(name, tuple(dict.fromkeys(texts))))
    else:
        axes.append(Axis("refine", ("0", "1")))
    axes.append(Axis("element", ("linear", "quadratic")))
    if isinstance(plain.solver, ImplicitSolver):
        own = plain.solver.name if plain.solver.max_iterations > 1 else "linearised"
        axes.append(Axis("solver", tuple(dict.fromkeys((own, "sdirk2")))))
        interval = 1.0 / plain.fps
        dt = interval if plain.dt == "auto" else min(plain.dt, interval)
        lengths = [dt * factor for factor in (2.0, 1.0, 0.5)]
        axes.append(Axis("dt", tuple(_fraction(length) for length in lengths if length <= interval)))
    return axes


def _fraction(length: float) -> str:
    """A time step as 1/n where it is one, so that it divides a frame as exactly as it was meant to."""
    count = round(1.0 / length)
    return f"1/{count}" if abs(count * length - 1.0) < 1e-9 else repr(length)
