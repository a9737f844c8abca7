"""The parts of a setting's error: of its mesh, its time steps, its algebra and its model.

Each is the difference that one change makes. Of implicit schemes:

- space: the setting's mesh with the reference's time steps, against the limit in space with those;
- time: its scheme and step on the reference's coarsest mesh, against the limit in time on that;
- algebra: the setting itself, against itself in float64 with a tolerance of 1e-8;
- model: what it changes of the problem, on the reference's coarsest mesh, against that without; equilibria in place of
  motion, which are not told from errors in time, are among that.

Where the reference takes explicit steps, those of the setting are halved instead, which leaves a part 2^-p of their
error, p being their order: what that changes is in time, the rest in space.
"""

from __future__ import annotations

from collections.abc import Sequence

from warpfem.solvers import Quasistatic, Solver
from warpfem.solvers.implicit import ImplicitSolver
from warpfem.trade.axes import MeshControl, kind_of
from warpfem.trade.outcome import Outcome
from warpfem.trade.problem import FORCED, Setting
from warpfem.trade.reference import FINE_ALGEBRA, Reference, relative
from warpfem.trade.study import Point, Study, difference

Errors = dict[str, float]
"""Relative errors by name of a norm or a quantity."""


def components(
    study: Study, mesh: MeshControl, reference: Reference, points: Sequence[Point]
) -> list[dict[str, Errors]]:
    """The parts of the errors of settings.

    Args:
        study: runs what they need.
        mesh: tells which axes set the mesh.
        reference: that of the settings.
        points: the settings, without failures.

    Returns:
        For each setting its parts by "space", "time", "algebra" and "model"; one that could not be run is missing.
    """
    separators = [_separator(study, mesh, reference, point) for point in points]
    study.solve(list(dict.fromkeys(setting for own in separators for setting in own.needed())))
    return [own.parts() for own in separators]


Pair = tuple[str, Outcome | None, Outcome | None, float]
"""The part that two outcomes tell by their difference, times a factor."""


class _Separator:
    """The runs that separate the errors of one setting: those of its algebra and its model, and others by its kind."""

    def __init__(self, study: Study, mesh: MeshControl, reference: Reference, point: Point, algebra: dict) -> None:
        self.study = study
        self.reference = reference
        self.point = point
        self.kinds = {name: kind_of(name, mesh) for name, _ in point.setting}
        self.shared = reference.ladders["space"][0].setting  # the coarsest mesh and the step of all meshes
        self.algebra = point.setting.changed(**algebra)
        in_time = {name for name, _ in self.shared if name not in mesh.names and name != f"{FORCED}element"}
        self.space = self.shared.only(in_time).changed(**self._own("space"))  # its mesh, with steps of the reference
        model = self._own("model")
        self.model = self.shared.changed(**model) if model else None

    def needed(self) -> list[Setting]:
        """What has to be run."""
        return [own for own in (*self._runs(), self.algebra, self.model) if own is not None]

    def parts(self) -> dict[str, Errors]:
        """The parts, once that has been run."""
        pairs = [*self._pairs(), ("algebra", self.point.first, self._outcome(self.algebra), 1.0)]
        if self.model is not None:
            pairs.append(("model", self._outcome(self.model), self._outcome(self.shared), 1.0))
        return {
            kind: self._errors(one, other, factor)
            for kind, one, other, factor in pairs
            if one is not None and other is not None
        }

    def _runs(self) -> list[Setting]:
        raise NotImplementedError

    def _pairs(self) -> list[Pair]:
        raise NotImplementedError

    def _own(self, kind: str) -> dict[str, str]:
        """What the setting says of a kind."""
        return {name: value for name, value in self.point.setting if self.kinds[name] == kind}

    def _outcome(self, setting: Setting) -> Outcome | None:
        (point,) = self.study.solve([setting])
        return None if point.failure else point.first

    def _errors(self, one: Outcome, other: Outcome, factor: float) -> Errors:
        found = relative(difference(one, other), self.reference.scales)
        return {name: factor * value for name, value in found.items()}


class _Implicit(_Separator):
    def __init__(self, study: Study, mesh: MeshControl, reference: Reference, point: Point) -> None:
        super().__init__(study, mesh, reference, point, FINE_ALGEBRA)
        plain = dict.fromkeys((f"{FORCED}solver", f"{FORCED}dt"))
        self.time = self.shared.changed(**plain).changed(**self._own("time"))

    def _runs(self) -> list[Setting]:
        return [self.space, self.time]

    def _pairs(self) -> list[Pair]:
        limits = self.reference.limits
        return [
            ("space", self._outcome(self.space), limits["space"], 1.0),
            ("time", self._outcome(self.time), limits["time"], 1.0),
        ]


class _Explicit(_Separator):
    def __init__(self, study: Study, mesh: MeshControl, reference: Reference, point: Point, solver: Solver) -> None:
        algebra = FINE_ALGEBRA if isinstance(solver, ImplicitSolver) else {"dtype": "float64"}
        super().__init__(study, mesh, reference, point, algebra)
        self.rest = 0.5**solver.order
        self.halved = point.setting.changed(**{f"{FORCED}dt": repr(0.5 * point.first.shortest_dt)})
        self.space = self.halved.changed(**dict.fromkeys(self._own("model")))

    def _runs(self) -> list[Setting]:
        return [self.halved, self.space]

    def _pairs(self) -> list[Pair]:
        return [
            ("space", self._outcome(self.space), self.reference.outcome, 1.0),
            ("time", self.point.first, self._outcome(self.halved), 1.0 / (1.0 - self.rest)),
        ]


class _AtRest(_Separator):
    def __init__(self, study: Study, mesh: MeshControl, reference: Reference, point: Point) -> None:
        super().__init__(study, mesh, reference, point, FINE_ALGEBRA)
        plain = dict.fromkeys((f"{FORCED}solver", f"{FORCED}dt"))
        self.model = self.shared.changed(**plain).changed(**self._own("time"), **self._own("model"))

    def _runs(self) -> list[Setting]:
        return [self.space]

    def _pairs(self) -> list[Pair]:
        limit = self.reference.limits["space"] if "time" in self.reference.limits else self.reference.outcome
        return [("space", self._outcome(self.space), limit, 1.0)]


def _separator(study: Study, mesh: MeshControl, reference: Reference, point: Point) -> _Separator:
    solver = study.problem.build(point.setting).scene.solver
    if isinstance(solver, Quasistatic):
        return _AtRest(study, mesh, reference, point)
    if isinstance(solver, ImplicitSolver) and "time" in reference.limits:
        return _Implicit(study, mesh, reference, point)
    return _Explicit(study, mesh, reference, point, solver)
