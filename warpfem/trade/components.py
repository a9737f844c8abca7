"""The parts of a setting's error: of its mesh, its time steps, its algebra and its model.

Each is the difference that one change makes. Of implicit schemes:

- space: the setting's mesh with the reference's time steps, against the limit in space with those;
- time: its scheme and step on the reference's coarsest mesh, against the limit in time on that;
- algebra: the setting itself, against itself in float64 with a tolerance of 1e-8;
- model: what it changes of the problem, on the reference's coarsest mesh, against that without.

Where the reference takes explicit steps, those of the setting are halved instead, which leaves a part 2^-p of their
error, p being their order: what that changes is in time, the rest in space.
"""

from __future__ import annotations

from collections.abc import Sequence

from warpfem.solvers import Solver
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


class _Separator:
    """The runs that separate the errors of one setting."""

    def __init__(self, study: Study, reference: Reference, point: Point) -> None:
        self.study = study
        self.reference = reference
        self.point = point

    def needed(self) -> list[Setting]:
        """What has to be run."""
        raise NotImplementedError

    def parts(self) -> dict[str, Errors]:
        """The parts, once that has been run."""
        raise NotImplementedError

    def _outcome(self, setting: Setting) -> Outcome | None:
        (point,) = self.study.solve([setting])
        return None if point.failure else point.first

    def _errors(self, one: Outcome, other: Outcome, factor: float = 1.0) -> Errors:
        found = relative(difference(one, other), self.reference.scales)
        return {name: factor * value for name, value in found.items()}


class _Implicit(_Separator):
    def __init__(self, study: Study, mesh: MeshControl, reference: Reference, point: Point) -> None:
        super().__init__(study, reference, point)
        shared = reference.ladders["space"][0].setting  # the coarsest mesh and the step of all meshes
        in_time = {name for name, _ in shared if name not in mesh.names and name != f"{FORCED}element"}
        kinds = {name: kind_of(name, mesh) for name, _ in point.setting}

        def own(kind: str) -> dict[str, str]:
            return {name: value for name, value in point.setting if kinds[name] == kind}

        self.space = shared.only(in_time).changed(**own("space"))
        plain = dict.fromkeys((f"{FORCED}solver", f"{FORCED}dt"))
        self.time = shared.changed(**plain).changed(**own("time")) if own("time") else shared.changed(**plain)
        self.algebra = point.setting.changed(**FINE_ALGEBRA)
        self.model = shared.changed(**own("model")) if own("model") else None
        self.shared = shared

    def needed(self) -> list[Setting]:
        return [own for own in (self.space, self.time, self.algebra, self.model) if own is not None]

    def parts(self) -> dict[str, Errors]:
        limits, found = self.reference.limits, {}
        pairs: list[tuple[str, Outcome | None, Outcome | None]] = [
            ("space", self._outcome(self.space), limits["space"]),
            ("time", self._outcome(self.time), limits["time"]),
            ("algebra", self.point.first, self._outcome(self.algebra)),
        ]
        if self.model is not None:
            pairs.append(("model", self._outcome(self.model), self._outcome(self.shared)))
        for kind, one, other in pairs:
            if one is not None and other is not None:
                found[kind] = self._errors(one, other)
        return found


class _Explicit(_Separator):
    def __init__(self, study: Study, mesh: MeshControl, reference: Reference, point: Point, solver: Solver) -> None:
        super().__init__(study, reference, point)
        self.order = solver.order
        model = {name: value for name, value in point.setting if kind_of(name, mesh) == "model"}
        self.halved = point.setting.changed(**{f"{FORCED}dt": repr(0.5 * point.first.shortest_dt)})
        self.space = self.halved.changed(**dict.fromkeys(model))
        self.algebra = point.setting.changed(
            **(FINE_ALGEBRA if isinstance(solver, ImplicitSolver) else {"dtype": "float64"})
        )
        self.shared = reference.ladders["space"][0].setting
        self.model = self.shared.changed(**model) if model else None

    def needed(self) -> list[Setting]:
        return [own for own in (self.halved, self.space, self.algebra, self.model) if own is not None]

    def parts(self) -> dict[str, Errors]:
        found = {}
        halved, space, exact = (self._outcome(own) for own in (self.halved, self.space, self.algebra))
        if space is not None:
            found["space"] = self._errors(space, self.reference.outcome)
        if halved is not None:
            found["time"] = self._errors(self.point.first, halved, 1.0 / (1.0 - 0.5**self.order))
        if exact is not None:
            found["algebra"] = self._errors(self.point.first, exact)
        if self.model is not None:
            changed, shared = self._outcome(self.model), self._outcome(self.shared)
            if changed is not None and shared is not None:
                found["model"] = self._errors(changed, shared)
        return found


def _separator(study: Study, mesh: MeshControl, reference: Reference, point: Point) -> _Separator:
    solver = study.problem.build(point.setting).scene.solver
    if isinstance(solver, ImplicitSolver) and "time" in reference.limits:
        return _Implicit(study, mesh, reference, point)
    return _Explicit(study, mesh, reference, point, solver)
