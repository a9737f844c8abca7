"""A scene file as a problem whose settings vary: what each setting makes of the scene."""

from __future__ import annotations

import difflib
import functools
import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import warp

from warpfem.boundary import PointForce
from warpfem.dtypes import FloatName
from warpfem.errors import SceneError
from warpfem.materials import MATERIALS, HookeanMaterial
from warpfem.scene import ELEMENTS, Body, Scene
from warpfem.scene_file import load_scene, scene_parameters, source_digest, value_of
from warpfem.solvers import SOLVERS, BackwardEuler, Solver
from warpfem.solvers.implicit import ImplicitSolver
from warpfem.solvers.newton import NewtonSettings

ELEMENT_ALIASES = {"P1": "linear", "P2": "quadratic"}

LINEARISED = "linearised"
"""Names backward Euler's single linear solve among the solvers."""

FORCED = "scene."
"""Begins names of axes that change what the scene's function returns, also where it has a parameter of that name."""

_FRACTION = re.compile(r"\d+(?:\.\d*)?/\d+(?:\.\d*)?")


@dataclass(frozen=True)
class Setting:
    """Values of axes, as text.

    Attributes:
        values: pairs of a name and a value.
    """

    values: tuple[tuple[str, str], ...] = ()

    @classmethod
    def of(cls, **values: object) -> Setting:
        """The setting with these values."""
        return cls(tuple((name, str(value)) for name, value in values.items()))

    def __iter__(self) -> Iterator[tuple[str, str]]:
        return iter(self.values)

    def __contains__(self, name: str) -> bool:
        return name in dict(self.values)

    def __getitem__(self, name: str) -> str:
        return dict(self.values)[name]

    def get(self, name: str, default: str = "") -> str:
        """The value of that name, if there is one."""
        return dict(self.values).get(name, default)

    def changed(self, **values: object) -> Setting:
        """The setting with other values of some names; ``None`` takes a name out."""
        own = dict(self.values) | {name: None if value is None else str(value) for name, value in values.items()}
        return Setting(tuple((name, value) for name, value in own.items() if value is not None))

    def only(self, names: Iterable[str]) -> Setting:
        """The part of the setting that has these names."""
        kept = set(names)
        return Setting(tuple(pair for pair in self.values if pair[0] in kept))

    @property
    def label(self) -> str:
        """The setting for people, as one would write it on the command line."""
        return " ".join(f"{name}={value}" for name, value in self.values) or "as written"

    @functools.cached_property
    def canonical(self) -> str:
        """The same for two settings that differ in their order alone."""
        return json.dumps(sorted(self.values))


@dataclass(frozen=True)
class Choice:
    """What a setting makes of a problem.

    Attributes:
        scene: the scene to run.
        dtype: the precision to run it in.
    """

    scene: Scene
    dtype: FloatName


@dataclass(frozen=True)
class Problem:
    """A scene file, and what all settings of it share.

    Attributes:
        path: the file.
        parameters: values of its parameters that hold unless an axis says otherwise, as on the command line.
        frames: frames to simulate; ``None`` as the scene says.
        device: Warp device; ``None`` takes Warp's default.
        digest: that of the file and what it imports; a worker elsewhere may have another file of that name.
        code: likewise, of this package.
        files: those of other programs that the scene as written reads, such as meshes, and their digests.
    """

    path: str
    parameters: tuple[tuple[str, str], ...] = ()
    frames: int | None = None
    device: str | None = None
    digest: str = ""
    code: str = ""
    files: tuple[tuple[str, str], ...] = ()

    @classmethod
    def of(
        cls,
        path: str | Path,
        parameters: Mapping[str, str] | None = None,
        *,
        frames: int | None = None,
        device: str | None = None,
    ) -> Problem:
        """The problem of a scene file.

        Raises:
            SceneError: there is no such file.
        """
        given = tuple((parameters or {}).items())
        return cls(str(Path(path).absolute()), given, frames, device, source_digest(path), code_digest())

    def reading(self, files: Iterable[Path]) -> Problem:
        """The same problem, with the files of other programs that its scene reads."""
        return replace(self, files=tuple((str(file), source_digest(file)) for file in sorted(files)))

    def key(self, setting: Setting) -> str:
        """Names the results of a setting: the same files, parameters, setting and code give the same."""
        code = [self.code, warp.__version__]
        parts = [self.digest, self.files, sorted(self.parameters), self.frames, self.device, setting.canonical, code]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:20]

    def require_same_files(self) -> None:
        """Raises SceneError if the scene's file, or one that it reads, is not there or another one; or warpfem is."""
        for path, digest in ((self.path, self.digest), *self.files):
            if source_digest(path) != digest:
                raise SceneError(f"{path} is not the file that the study was begun with")
        if code_digest() != self.code:
            raise SceneError("this is not the code of warpfem that the study was begun with")

    def parameter_names(self) -> list[str]:
        """The parameters of the file's function ``scene``."""
        return list(scene_parameters(self.path))

    def build(self, setting: Setting) -> Choice:
        """The scene of a setting.

        A name that is a parameter of the scene's function is given to it; the others change the scene that it returns,
        as do names that begin with ``scene.``, such as ``scene.dt``, whatever parameters there are.

        Raises:
            WarpfemError: there is no such setting of this scene.
        """
        own = self.parameter_names()
        if setting.get("dt") == "auto" and "dt" in own:  # where the parameter is a number
            forced = {f"{FORCED}dt": setting.get(f"{FORCED}dt", "auto")}
            return self.build(setting.changed(dt=None).changed(**forced))
        given = dict(self.parameters) | {name: _literal(name, value) for name, value in setting if name in own}
        scene = load_scene(self.path, given)
        rest = {name: value for name, value in setting if name not in own and not name.startswith(FORCED)}
        rest |= {name.removeprefix(FORCED): value for name, value in setting if name.startswith(FORCED)}
        if self.frames is not None:
            scene = replace(scene, frames=self.frames)
        for name, change in _CHANGES.items():
            if name in rest:
                scene = change(scene, rest.pop(name))
        dtype = rest.pop("dtype", "float32")
        if dtype not in ("float32", "float64"):
            raise SceneError(f"dtype must be float32 or float64, not '{dtype}'")
        for name, value in rest.items():
            scene = replace(scene, solver=_with_field(scene.solver, name, value))
        return Choice(scene, dtype)  # type: ignore[arg-type]

    def applicable(self, setting: Setting) -> Setting:
        """The setting without what its solver does not have, such as the tolerance of explicit steps."""
        solver_fields = SOLVER_FIELDS - set(self.parameter_names())
        asked = [name for name, _ in setting if name in solver_fields]
        if not asked:
            return setting
        scene = self.build(setting.changed(**dict.fromkeys(asked))).scene
        lacking = [name for name in asked if name not in {field.name for field in fields(scene.solver)}]  # type: ignore[arg-type]
        return setting.changed(**dict.fromkeys(lacking))


@functools.cache
def code_digest() -> str:
    """Names the code of this package, which a version does not while it is worked on."""
    package = Path(__file__).parent.parent
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        digest.update(
            f"{file.relative_to(package).as_posix()} {hashlib.sha256(file.read_bytes()).hexdigest()}".encode()
        )
    return digest.hexdigest()


def known_names(parameters: Sequence[str]) -> list[str]:
    """What axes of a scene with these parameters can be called."""
    return [*parameters, *(name for name in [*_CHANGES, "dtype", *sorted(SOLVER_FIELDS)] if name not in parameters)]


def require_known(name: str, parameters: Sequence[str]) -> None:
    """Raises SceneError, with the name that may have been meant, if there is no such axis."""
    known = known_names(parameters)
    if name.removeprefix(FORCED) not in known:
        close = difflib.get_close_matches(name, known, 1)
        hint = f"; did you mean '{close[0]}'?" if close else "."
        own = ", ".join(parameters) or "none"
        others = ", ".join(known[len(parameters) :])
        raise SceneError(f"there is no axis '{name}'{hint} The scene's parameters: {own}; others: {others}")


def mesh_size(scene: Scene) -> float:
    """The mean size of the cells, (volume / cells)^(1/dim) [m]."""
    volume = sum(float(body.mesh.cell_volumes.sum()) for body in scene.bodies)
    return (volume / sum(body.mesh.cell_count for body in scene.bodies)) ** (1.0 / scene.dim)


def _literal(name: str, text: str) -> str:
    """The text as ``load_scene`` takes it: fractions become numbers, and short names of elements long ones."""
    if name == "element":
        return ELEMENT_ALIASES.get(text, text)
    return repr(number(text)) if _FRACTION.fullmatch(text) else text


def number(text: str) -> float:
    """The number that a text says, which may be a fraction such as 1/48.

    Raises:
        SceneError: it says none.
    """
    above, _, below = text.partition("/")
    try:
        return float(above) / float(below or 1.0)
    except (ValueError, ZeroDivisionError):
        raise SceneError(f"'{text}' is no number") from None


# ---- changes of a scene


def _with_refinements(scene: Scene, text: str) -> Scene:
    if not text.isdecimal():
        raise SceneError(f"refine must be how often all cells are divided, 0, 1, 2, ..., not '{text}'")
    bodies = list(scene.bodies)
    for _ in range(int(text)):
        bodies = [body.refined() for body in bodies]
    return replace(scene, bodies=bodies)


def _with_material(scene: Scene, text: str) -> Scene:
    kind = _choice("material", text, MATERIALS)

    def changed(body: Body) -> Body:
        if not isinstance(body.material, HookeanMaterial):
            raise SceneError(f"body '{body.name}': {type(body.material).__name__} has no E and nu to keep")
        return replace(body, material=kind(mu=body.material.mu, lam=body.material.lam))

    return replace(scene, bodies=[changed(body) for body in scene.bodies])


def _with_element(scene: Scene, text: str) -> Scene:
    element = ELEMENT_ALIASES.get(text, text)
    if element not in ELEMENTS:
        raise SceneError(f"element must be one of {', '.join((*ELEMENTS, *ELEMENT_ALIASES))}, not '{text}'")

    def changed(body: Body) -> Body:
        loads = [  # on the same points, whatever their set gains
            replace(load, points=body.mesh.select_points(load.points)) if isinstance(load, PointForce) else load
            for load in body.loads
        ]
        return replace(body, element=element, loads=loads)  # type: ignore[arg-type]

    return replace(scene, bodies=[changed(body) for body in scene.bodies])


def _with_solver(scene: Scene, text: str) -> Scene:
    kinds = {**SOLVERS, LINEARISED: BackwardEuler}
    kind = _choice("solver", text, kinds)
    if text == LINEARISED:
        return replace(scene, solver=BackwardEuler.linearised())
    kept = {}
    before = scene.solver
    if issubclass(kind, ImplicitSolver) and isinstance(before, ImplicitSolver) and before.max_iterations > 1:
        kept = {field.name: getattr(before, field.name) for field in fields(NewtonSettings)}
    return replace(scene, solver=kind(**kept))


def _with_dt(scene: Scene, text: str) -> Scene:
    return replace(scene, dt="auto" if text == "auto" else number(text))


_CHANGES = {
    "refine": _with_refinements,
    "material": _with_material,
    "element": _with_element,
    "solver": _with_solver,
    "dt": _with_dt,
}
"""What changes a scene that is no parameter of it, in the order in which it is done."""

SOLVER_FIELDS = {field.name for kind in SOLVERS.values() for field in fields(kind)}  # type: ignore[arg-type]
"""Names of the settings of solvers."""


def _with_field(solver: Solver, name: str, text: str) -> Solver:
    kind = type(solver).__name__
    known = {field.name: getattr(solver, field.name) for field in fields(solver)}  # type: ignore[arg-type]
    if name not in known:
        raise SceneError(f"{kind} has no setting '{name}'")
    default: Any = known[name]
    value = value_of(kind, name, _literal(name, text), default)
    return replace(solver, **{name: value})  # type: ignore[type-var]


def _choice(what: str, text: str, kinds: Mapping[str, Any]) -> Any:
    """One of some classes, by its short name or its own."""
    named = {**kinds, **{kind.__name__: kind for kind in kinds.values()}}
    if text not in named:
        close = difflib.get_close_matches(text, named, 1)
        hint = f"; did you mean '{close[0]}'?" if close else "."
        raise SceneError(f"there is no {what} '{text}'{hint} There are: {', '.join(named)}")
    return named[text]
