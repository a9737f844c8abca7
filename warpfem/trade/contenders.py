"""The settings that may be the cheapest within an error, found by one-level changes rather than in all combinations.

With explicit steps, how fine a mesh each kind of cells needs; on a coarse mesh, how long the steps of each implicit
scheme may be, as far as it is not dearer already than what was found; and how fine a mesh those need. The share of the
error that is left to time is that at which less of it costs the same in space and in time. Since errors of coarse
settings compensate, the longest steps are sought once more on the meshes that were found, where all errors count.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from warpfem.materials import HookeanMaterial, LinearElasticity
from warpfem.solvers import SOLVERS, ImplicitMidpoint, Quasistatic
from warpfem.solvers.implicit import ImplicitSolver
from warpfem.trade.axes import MeshControl
from warpfem.trade.ladders import Rung
from warpfem.trade.problem import FORCED, LINEARISED, Setting
from warpfem.trade.trials import Trial, Trials, coarsest_within, finer_in_time, steps_of, with_steps
from warpfem.trade.tuning_reference import EXPLICIT, coarser

SIMPLER = 0.3
"""The part of the error that a simpler model may take."""

FASTER = 0.9
"""Part of the cost below which a simpler model or a looser tolerance is taken."""

CONTENDERS = 3
"""Settings that are run to the end in each round."""

PROMISING = 1.6
"""Times the cost of the cheapest up to which a setting is run to the end: part of the frames tell it that well."""

ORDERS = {"linear": 2.0, "averaged": 2.0, "quadratic": 3.0}
"""Expected orders in space of the displacement."""

MEAN_ORDER = 2.5
"""Of linear and quadratic cells."""

NEARLY_INCOMPRESSIBLE = 0.4
"""Poisson's ratio from which on averaged cells are tried."""

ROUGH = 1e-3
"""Errors above which the tolerance of solvers is no obstacle."""

LEAN = 0.7
"""The power of the number of points with which the cost of a step grows at least."""

LINEAR = {f"{FORCED}material": LinearElasticity.name}
TIGHT = {f"{FORCED}tolerance": "1e-6"}


class Contenders:
    """The search.

    Args:
        trials: tries settings.
        mesh: makes meshes finer.
        explicit: whether explicit steps are cheap enough to be tried.
        coarse: the first run of the reference, with what it has recorded of the frames of the trials, free of errors
            in time.
    """

    def __init__(self, trials: Trials, mesh: MeshControl, explicit: bool, coarse: Rung) -> None:
        self.trials = trials
        self.mesh = mesh
        self.explicit = explicit
        self.scene = trials.study.scene
        self.fps = float(self.scene.fps)
        self.coarse = trials.against(coarse.outcome)
        self.coarse_mesh = coarse.setting.only({*mesh.names, f"{FORCED}element"})
        self.coarse_points = coarse.outcome.points
        self.points: dict[str, int] = {}  # that each kind of cells has needed
        self.starts: dict[str, Setting] = {}  # the meshes that have
        self.linear_error = self._linear_error(coarse.setting)

    @property
    def tried(self) -> set[Setting]:
        """All settings that were tried."""
        return self.trials.tried.keys() | self.coarse.tried.keys()

    def within(self, goal: float, hopeless: float, excluded: Collection[Setting] = ()) -> list[Trial]:
        """The cheapest settings that may have the error wanted over all frames, but for some; from fast to slow.

        Args:
            goal: the error, on the frames of the trials, of those that are sought.
            hopeless: that above which none has the error wanted over all frames. What has been tried, has less, and is
                cheaper than all that was found, is given too.
            excluded: settings that are not given.
        """
        found = self._within(goal, excluded)
        return self._cheaper(FASTER * _least(found), hopeless, excluded) + found

    def _cheaper(self, seconds: float, most: float, excluded: Collection[Setting]) -> list[Trial]:
        """What was tried and takes less time, errs by no more, and of which none is both faster and more accurate."""
        tried = {t.setting: t for t in self.trials.tried.values() if t.seconds < seconds and t.error <= most}
        front: list[Trial] = []
        for trial in sorted((t for t in tried.values() if t.setting not in excluded), key=lambda t: t.seconds):
            if not front or trial.error < front[-1].error:
                front.append(trial)
        return front[-CONTENDERS:]

    def _within(self, goal: float, excluded: Collection[Setting]) -> list[Trial]:
        """The cheapest settings whose error on the frames of the trials is within a goal."""
        found: list[Trial] = []
        if self.explicit:
            for base in self._by_promise([_with(EXPLICIT, element) for element in self._elements()], goal):
                self._add(found, base, goal)
        levels = [level for level in (self._at_rest(goal), *self._time_levels(goal, found)) if level is not None]
        for level in sorted(levels, key=lambda t: t.seconds):
            scheme = dict(level.setting.only({name for name, _ in level.setting} - self.mesh.names))
            bases = [
                _with(scheme, element)
                for element in self._elements()
                if level.seconds * max(1.0, self._growth(element)) <= PROMISING * _least(found)
            ]
            for base in self._by_promise(bases, goal):
                self._add(found, base, goal)
        for element in list(self.starts):
            self._add_longest_steps(found, element, goal)
        found = sorted((t for t in found if t.setting not in excluded), key=lambda t: t.seconds)
        found += self._linear(found[:1], goal)
        found.sort(key=lambda t: t.seconds)
        return [trial for trial in found if trial.seconds <= PROMISING * found[0].seconds][:CONTENDERS]

    def _by_promise(self, bases: Sequence[Setting], goal: float) -> list[Setting]:
        """Kinds of cells in the order of what the goal may cost with them, by their first mesh."""

        def cost(trial: Trial, base: Setting) -> float:
            power = (self.scene.dim + 0.5) / ORDERS[base[f"{FORCED}element"]]
            return trial.seconds * max(1.0, trial.error / goal) ** power

        firsts = self.trials.run([self._start(base) for base in bases])
        costs = [cost(first, base) for first, base in zip(firsts, bases, strict=True)]
        return [bases[k] for k in np.argsort(costs, kind="stable")]

    def _start(self, base: Setting) -> Setting:
        """The setting with the mesh that its kind of cells begins with: what it has needed so far, or a coarse one."""
        return base.changed(**dict(self.starts.get(base[f"{FORCED}element"]) or coarser(self.mesh, Setting(), 2)))

    def _add(self, found: list[Trial], base: Setting, goal: float) -> None:
        """Adds the coarsest mesh that is within the goal, if there is one at a cost that is of interest."""
        element = base[f"{FORCED}element"]
        trial = coarsest_within(
            self.trials.one,
            self._start(base),
            self.mesh.finer,
            lambda own: 1.0 / own.outcome.mesh_size,
            goal=goal,
            order=ORDERS[element],
            growth=self.scene.dim + 0.5,
            most_seconds=min(PROMISING * _least(found), self.trials.study.limit),
        )
        if trial is not None:
            found.append(trial)
            self.starts.setdefault(element, trial.setting.only(self.mesh.names))
            self.points.setdefault(element, trial.outcome.points)

    def _add_longest_steps(self, found: list[Trial], element: str, goal: float) -> None:
        """Adds, for each implicit scheme, the longest steps that are within the goal on the mesh of these cells."""
        mesh = self.starts[element].changed(**{f"{FORCED}element": element})
        for scheme, order in self._schemes().items():
            most = PROMISING * _least(found)
            coarse = self.coarse.one(self._one_step(self.coarse_mesh, scheme))
            if coarse.seconds * self._growth(element) > most:
                continue
            trial = coarsest_within(
                self.trials.one,
                self._one_step(mesh, scheme),
                finer_in_time(self.fps),
                lambda own: float(steps_of(own.setting, self.fps)),
                goal=goal,
                order=order,
                growth=LEAN,
                most_seconds=min(most, self.trials.study.limit),
            )
            if trial is not None:
                found.append(trial)

    def _one_step(self, mesh: Setting, scheme: str) -> Setting:
        """A step of a frame of an implicit scheme."""
        return with_steps(mesh.changed(**{f"{FORCED}solver": scheme}), self.fps, 1)

    def _growth(self, element: str) -> float:
        """By how much a step costs more than on the coarse mesh, at least."""
        return (self.points.get(element, 0) / self.coarse_points) ** LEAN

    def _time_levels(self, goal: float, found: list[Trial]) -> list[Trial | None]:
        """For each implicit scheme the longest steps whose error is within time's share of the goal."""
        growth = max(1.0, min(map(self._growth, self.points), default=1.0))
        most = min(PROMISING * _least(found) / growth, self.trials.study.limit)
        return [self._time_level(scheme, order, goal, most) for scheme, order in self._schemes().items()]

    def _at_rest(self, goal: float) -> Trial | None:
        """Equilibria in place of motion, where that makes little difference on the coarse mesh."""
        level = self.coarse.one(self._one_step(self.coarse_mesh, Quasistatic.name))
        return level if level.error <= SIMPLER * goal else None

    def _time_level(self, scheme: str, order: float, goal: float, most_seconds: float) -> Trial | None:
        share = (1.0 / order) / (1.0 / order + (self.scene.dim + 0.5) / MEAN_ORDER)
        base = self._one_step(self.coarse_mesh, scheme)
        first = self.coarse.one(base)
        if not first.seconds <= most_seconds and not first.point.failure:
            return None
        if self.linear_error <= SIMPLER * goal:
            simple = self.coarse.one(base.changed(**LINEAR))
            if simple.seconds < FASTER * first.seconds:
                base = base.changed(**LINEAR)
        for tighter in ({}, TIGHT):
            level = coarsest_within(
                self.coarse.one,
                base.changed(**tighter),
                finer_in_time(self.fps),
                lambda own: float(steps_of(own.setting, self.fps)),
                goal=share * goal + (self.linear_error if f"{FORCED}material" in base else 0.0),
                order=order,
                growth=LEAN,
                most_seconds=most_seconds,
            )
            if level is not None or scheme == LINEARISED or goal > ROUGH:
                return level
        return None

    def _linear(self, found: Sequence[Trial], goal: float) -> list[Trial]:
        """The settings with linear elasticity, where that does and is faster."""
        if self.linear_error > SIMPLER * goal:
            return []
        simple = self.trials.run([t.setting.changed(**LINEAR) for t in found if f"{FORCED}material" not in t.setting])
        return [own for own in simple if own.error <= goal and own.seconds < FASTER * found[0].seconds]

    def _linear_error(self, setting: Setting) -> float:
        """The difference that linear elasticity makes on the coarse mesh; infinite where it cannot be had."""
        materials = [body.material for body in self.scene.bodies]
        own = all(isinstance(material, HookeanMaterial) for material in materials)
        if not own or all(isinstance(material, LinearElasticity) for material in materials):
            return math.inf
        return self.coarse.one(setting.changed(**LINEAR)).error

    def _elements(self) -> list[str]:
        """The kinds of cells that are tried."""
        materials = [body.material for body in self.scene.bodies]
        nus = [np.max(np.asarray(own.nu, dtype=np.float64)) for own in materials if isinstance(own, HookeanMaterial)]
        averaged = max(nus, default=0.0) >= NEARLY_INCOMPRESSIBLE
        return ["linear", "quadratic", *(["averaged"] if averaged else [])]

    def _schemes(self) -> dict[str, float]:
        """The implicit schemes that are tried, and their orders in time."""
        schemes = {LINEARISED: 1.0}
        schemes |= {name: float(kind.order) for name, kind in SOLVERS.items() if issubclass(kind, ImplicitSolver)}
        if self.scene.obstacles:
            del schemes[ImplicitMidpoint.name]
        return schemes


def _with(values: Mapping[str, str], element: str) -> Setting:
    return Setting.of(**{**values, f"{FORCED}element": element})


def _least(found: Sequence[Trial]) -> float:
    return min((trial.seconds for trial in found), default=math.inf)
