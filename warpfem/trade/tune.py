"""Finds the cheapest setting of a scene within an error, without trying all.

1. A reference is built whose error band is a part of the error asked for, or the search is refused.
2. On the first part of the frames settings are tried, by one-level changes: how fine a mesh each kind of cells needs
   with explicit steps; which implicit schemes take steps so long that they are cheaper, on a coarse mesh; and how fine
   a mesh those need. The share of the error that is left to time is that at which less of it costs the same in space
   and in time.
3. The cheapest ones are run to the end. The frames that the search has not seen show whether they hold; if they do
   not, or are far more accurate than asked, the search is repeated for a smaller or larger error.
4. Of the one that is left the tolerance is loosened, as far as that makes it faster and its error allows it.

Linear elasticity takes the place of another law only where the difference that it makes on a coarse mesh is a small
part of the error asked for, and where it is faster. Other models, such as plane strain, are a scene's own to offer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from warpfem.errors import SimulationError
from warpfem.materials import HookeanMaterial, LinearElasticity
from warpfem.scene import Scene
from warpfem.solvers import SOLVERS, ImplicitMidpoint, VelocityVerlet
from warpfem.solvers.implicit import ImplicitSolver
from warpfem.trade.axes import MeshControl
from warpfem.trade.components import components
from warpfem.trade.front import RESOLVED, advice, label, percent
from warpfem.trade.outcome import Outcome
from warpfem.trade.problem import FORCED, LINEARISED, Setting
from warpfem.trade.reference import FINE_ALGEBRA, L2, LARGEST, Reference, build_reference, relative
from warpfem.trade.study import Point, Study, difference
from warpfem.trade.trials import AIM, TINY, Trial, Trials, coarsest_within, finer_in_time, steps_of, with_steps

PRECISE = 0.1
"""The error band of the reference that is aimed at, as a part of the error asked for."""

SAFE = 0.95
"""The part of the error asked for that the search uses."""

SLACK = 0.65
"""Of the error asked for: a setting that is more accurate is worth another search."""

SIMPLER = 0.3
"""The part of the error that a simpler model may take."""

PART = 0.5
"""The part of the frames on which settings are tried."""

FEWEST_FRAMES = 8
"""Scenes of fewer frames are not divided."""

SEARCHES = 4
"""How often the search is repeated for another error."""

CONTENDERS = 3
"""Settings that are run to the end in each round."""

PROMISING = 1.6
"""Times the cost of the cheapest up to which a setting is run to the end: part of the frames tell it that well."""

ORDERS = {"linear": 2.0, "averaged": 2.0, "quadratic": 3.0}
"""Expected orders in space of the displacement."""

NEARLY_INCOMPRESSIBLE = 0.4
"""Poisson's ratio from which on averaged cells are tried."""

FASTER = 0.9
"""Part of the cost below which a simpler model or a looser tolerance is taken."""

CHEAP = 10.0
"""Seconds of the coarsest run of a reference below which explicit steps are not compared with others."""

FAVOUR = 3.0
"""Times the cost on the coarsest mesh up to which explicit steps are preferred for references: float64 and three stages
make implicit ones dear, but those need fewer steps on fine meshes."""

MOST_RELAXED = 3.0
"""By how much the error of a search grows at most."""

ROUGH = 1e-3
"""Errors above which the tolerance of solvers is no obstacle."""

MEAN_ORDER = 2.5
"""Of linear and quadratic cells."""

EXPLICIT = {f"{FORCED}solver": VelocityVerlet.name, f"{FORCED}dt": "auto"}
LINEAR = {f"{FORCED}material": LinearElasticity.name}
TIGHT = {f"{FORCED}tolerance": "1e-6"}

LEAN = 0.7
"""The power of the number of points with which the cost of a step grows at least."""


@dataclass(frozen=True, eq=False)
class Tuned:
    """What was found.

    Attributes:
        name: of the norm or quantity that the error is of.
        target: the relative error asked for.
        setting: the setting.
        point: its runs, one at a time, over all frames.
        error: relative, over all frames, against the reference.
        seen, unseen: relative errors over the frames on which it was chosen, and over the others; ``None`` of
            quantities of the whole motion.
        frames: how many frames, after the initial one, it was chosen on.
        reference: what errors are against.
        parts: of its error, by "space", "time", "algebra" and "model".
        contenders: all that was run to the end for it, from fast to slow.
        tried: settings that were run, those of the reference not counted.
    """

    name: str
    target: float
    setting: Setting
    point: Point
    error: float
    seen: float | None
    unseen: float | None
    frames: int
    reference: Reference
    parts: dict[str, float]
    contenders: list[Trial]
    tried: int

    @property
    def band(self) -> float:
        """What the error may be off by."""
        return self.reference.band(self.name)


def tune(study: Study, mesh: MeshControl, name: str, target: float, *, repeats: int = 3) -> Tuned:
    """Finds the cheapest setting within an error.

    Args:
        study: runs settings.
        mesh: how the scene's mesh is made finer.
        name: of what the error is: "l2", "max" or a quantity of the scene.
        target: the relative error.
        repeats: processes that time what was found.

    Raises:
        SimulationError: there is no reference that is accurate enough, or no such setting.
        OutputError: something cannot be stored, or the cluster is lost.
    """
    return _Tuner(study, mesh, name, target).tune(repeats)


class _Tuner:
    def __init__(self, study: Study, mesh: MeshControl, name: str, target: float) -> None:
        self.study = study
        self.mesh = mesh
        self.name = name
        self.target = target
        self.scene: Scene = study.scene
        self.fps = float(self.scene.fps)
        frames = int(self.scene.frames)
        divided = name in (L2, LARGEST) and frames >= FEWEST_FRAMES
        self.frames = math.ceil(PART * frames) if divided else frames
        self.coarsest, self.explicit = self._beginning()
        self.reference = self._accurate_reference()
        self.band = self.reference.band(name)
        first = self.reference.ladders["space"][0]
        self.coarse_mesh = first.setting.only({*mesh.names, f"{FORCED}element"})
        self.coarse_points = first.outcome.points
        on_coarse = self.reference.limits.get("time", first.outcome)
        self.early = Trials(study.shortened(self.frames), self._seen(self.reference.outcome), name)
        self.coarse = self.early.against(self._seen(on_coarse))
        self.whole = Trials(study, self.reference, name)
        self.points: dict[str, int] = {}  # that each kind of cells has needed
        self.starts: dict[str, Setting] = {}  # the meshes that have
        self.linear_error = self._linear_error()
        self.failed: set[Setting] = set()  # what could not be run to the end

    def tune(self, repeats: int) -> Tuned:
        winner, ended = self._search()
        winner = self._loosened(winner)
        (point,) = self.study.alone().run([winner.setting], repeats)
        (parts,) = components(self.study, self.mesh, self.reference, [point])
        own = {kind: errors[self.name] for kind, errors in parts.items() if self.name in errors}
        if f"{FORCED}material" in winner.setting:
            own["model"] = self.linear_error
        seen, unseen = self._divided(point.first)
        contenders = sorted(ended.values(), key=lambda t: t.seconds)
        tried = {*self.early.tried, *self.coarse.tried, *self.whole.tried}
        return Tuned(
            self.name,
            self.target,
            winner.setting,
            point,
            self.reference.errors(point.first)[self.name],
            seen,
            unseen,
            self.frames,
            self.reference,
            own,
            contenders,
            len(tried),
        )

    # ---- the reference

    def _beginning(self) -> tuple[Setting, bool]:
        """The coarsest mesh of the reference, and whether explicit steps make it cheaper.

        Raises:
            SimulationError: no mesh can be run.
        """
        for factor in (4, 2, 1):
            mesh = coarser(self.mesh, Setting(), factor)
            (point,) = self.study.solve([self._fine(mesh, explicit=True)])
            if not point.failure and point.seconds < CHEAP:
                return mesh, True
            (other,) = self.study.solve([self._fine(mesh, explicit=False)])
            if not point.failure:
                return mesh, bool(other.failure) or point.seconds < FAVOUR * other.seconds
            if not other.failure:
                return mesh, False
        raise SimulationError(f"there is no reference: {other.failure}")

    def _fine(self, mesh: Setting, explicit: bool) -> Setting:
        """A mesh of quadratic cells, accurate in time."""
        base = mesh.changed(**{f"{FORCED}element": "quadratic"})
        if explicit:
            return base.changed(dtype="float64", **EXPLICIT)
        return with_steps(base.changed(**FINE_ALGEBRA, **{f"{FORCED}solver": "sdirk3"}), self.fps, 2)

    def _accurate_reference(self) -> Reference:
        how = "explicit" if self.explicit else "implicit"
        self.study.say(f"a reference for {percent(self.target)}, by {how} steps")
        (start,) = self.study.solve([self._fine(self.coarsest, self.explicit)])
        reference = build_reference(
            self.study, self.mesh, [start], self.name, within=PRECISE * self.target, explicit=self.explicit
        )
        if not reference.scales[self.name] > 0.0:
            raise SimulationError(f"the reference has 0 for {label(self.name)}: no error is relative to that")
        band = reference.band(self.name)
        if not band <= RESOLVED * self.target:
            raise SimulationError(
                f"no setting can be told to be within {percent(self.target)} of {label(self.name)}: the reference "
                f"itself may be off by {percent(band)}. {advice(reference, self.name)}"
            )
        return reference

    def _seen(self, outcome: Outcome) -> Reference:
        """The reference with the first frames of an outcome."""
        count = self.frames + 1
        return replace(
            self.reference, outcome=replace(outcome, times=outcome.times[:count], motion=outcome.motion[:count])
        )

    def _divided(self, outcome: Outcome) -> tuple[float | None, float | None]:
        """The errors of an outcome over the frames on which it was chosen, and over the others."""
        if self.frames == self.scene.frames:
            return None, None
        found = []
        for frames in (slice(self.frames + 1), slice(self.frames + 1, None)):
            own, exact = (replace(o, times=o.times[frames], motion=o.motion[frames]) for o in (outcome, self._exact))
            found.append(relative(difference(own, exact), self.reference.scales)[self.name])
        return found[0], found[1]

    @property
    def _exact(self) -> Outcome:
        return self.reference.outcome

    def _linear_error(self) -> float:
        """The difference that linear elasticity makes on the coarse mesh; infinite where it cannot be had."""
        materials = [body.material for body in self.scene.bodies]
        own = all(isinstance(material, HookeanMaterial) for material in materials)
        if not own or all(isinstance(material, LinearElasticity) for material in materials):
            return math.inf
        first = self.reference.ladders["space"][0].setting
        return self.coarse.one(first.changed(**LINEAR)).error

    # ---- the search

    def _search(self) -> tuple[Trial, dict[Setting, Trial]]:
        """The cheapest setting that is within the error over all frames, and all that were run over all."""
        limit = self.target - self.band
        goal = SAFE * limit
        ended: dict[Setting, Trial] = {}
        holding: list[Trial] = []
        for _ in range(SEARCHES):
            found = [trial for trial in self._contenders(goal) if trial.setting not in ended]
            if not found:
                break
            last = self.whole.run([trial.setting for trial in found])
            ended |= {trial.setting: trial for trial in last}
            # the goal at which each would be just within the error, if the rest of the frames is as much harder for all
            just = {
                own.setting: AIM * early.error * limit / max(own.error, TINY)
                for early, own in zip(found, last, strict=True)
                if not own.point.failure
            }
            self.failed |= {own.setting for own in last if own.point.failure}
            held = [trial for trial in last if trial.error <= limit]
            if holding and not held:
                break
            holding += held
            if not holding:
                goal = min(just.values(), default=goal)
                continue
            best = min(holding, key=lambda t: t.seconds)
            relaxed = min(just.get(best.setting, 0.0), MOST_RELAXED * goal)
            if best.error >= SLACK * self.target or relaxed <= goal:
                break
            goal = relaxed
        if not holding:
            tried = "; ".join(f"{t.setting.label} is off by {percent(t.error)}" for t in ended.values())
            raise SimulationError(
                f"no setting within {percent(self.target)} of {label(self.name)} was found in runs of up to "
                f"{self.study.limit:g} s{': ' + tried if tried else ''}"
            )
        return min(holding, key=lambda t: t.seconds), ended

    def _contenders(self, goal: float) -> list[Trial]:
        """The cheapest settings whose error over the first frames is within a goal."""
        self.study.say(f"settings within {percent(goal)} on the first {self.frames} frames")
        found: list[Trial] = []
        if self.explicit:
            for base in self._by_promise([_with(EXPLICIT, element) for element in self._elements()], goal):
                self._add(found, base, goal)
        levels = [level for level in self._time_levels(goal, found) if level is not None]
        for level in sorted(levels, key=lambda t: t.seconds):
            for element in self._elements():
                expected = level.seconds * max(1.0, self._growth(element))
                if expected <= PROMISING * _least(found):
                    base = level.setting.only({name for name, _ in level.setting} - self.mesh.names)
                    self._add(found, _with(dict(base), element), goal)
        found = sorted((t for t in found if t.setting not in self.failed), key=lambda t: t.seconds)
        found += self._linear(found[:1], goal)
        found.sort(key=lambda t: t.seconds)
        return [trial for trial in found if trial.seconds <= PROMISING * found[0].seconds][:CONTENDERS]

    def _by_promise(self, bases: Sequence[Setting], goal: float) -> list[Setting]:
        """Kinds of cells in the order of what the goal may cost with them, by their first mesh."""

        def cost(trial: Trial, base: Setting) -> float:
            power = (self.scene.dim + 0.5) / ORDERS[base[f"{FORCED}element"]]
            return trial.seconds * max(1.0, trial.error / goal) ** power

        firsts = self.early.run([self._start(base) for base in bases])
        costs = [cost(first, base) for first, base in zip(firsts, bases, strict=True)]
        return [bases[k] for k in np.argsort(costs, kind="stable")]

    def _start(self, base: Setting) -> Setting:
        """The setting with the mesh that its kind of cells begins with: what it has needed so far, or a coarse one."""
        return base.changed(**dict(self.starts.get(base[f"{FORCED}element"]) or coarser(self.mesh, Setting(), 2)))

    def _add(self, found: list[Trial], base: Setting, goal: float) -> None:
        """Adds the coarsest mesh that is within the goal, if there is one at a cost that is of interest."""
        element = base[f"{FORCED}element"]
        trial = coarsest_within(
            self.early.one,
            self._start(base),
            self.mesh.finer,
            lambda own: 1.0 / own.outcome.mesh_size,
            goal=goal,
            order=ORDERS[element],
            growth=self.scene.dim + 0.5,
            most_seconds=min(PROMISING * _least(found), self.study.limit),
        )
        if trial is not None:
            found.append(trial)
            self.starts.setdefault(element, trial.setting.only(self.mesh.names))
            self.points.setdefault(element, trial.outcome.points)

    def _growth(self, element: str) -> float:
        """By how much a step costs more than on the coarse mesh, at least."""
        return (self.points.get(element, 0) / self.coarse_points) ** LEAN

    def _time_levels(self, goal: float, found: list[Trial]) -> list[Trial | None]:
        """For each implicit scheme the longest steps whose error is within time's share of the goal."""
        growth = max(1.0, min(map(self._growth, self.points), default=1.0))
        most = min(PROMISING * _least(found) / growth, self.study.limit)
        return [self._time_level(scheme, goal, most) for scheme in self._schemes()]

    def _time_level(self, scheme: str, goal: float, most_seconds: float) -> Trial | None:
        order = 1.0 if scheme == LINEARISED else float(SOLVERS[scheme].order)
        share = (1.0 / order) / (1.0 / order + (self.scene.dim + 0.5) / MEAN_ORDER)
        base = with_steps(self.coarse_mesh.changed(**{f"{FORCED}solver": scheme}), self.fps, 1)
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
        simple = self.early.run([t.setting.changed(**LINEAR) for t in found if f"{FORCED}material" not in t.setting])
        return [own for own in simple if own.error <= goal and own.seconds < FASTER * found[0].seconds]

    def _loosened(self, winner: Trial) -> Trial:
        """The setting with the largest tolerance that is within the error and makes it faster."""
        solver = self.study.problem.build(winner.setting).scene.solver
        if not isinstance(solver, ImplicitSolver) or solver.max_iterations == 1:
            return winner  # there is no tolerance
        for factor in (10.0, 100.0):
            trial = self.whole.one(winner.setting.changed(**{f"{FORCED}tolerance": f"{factor * solver.tolerance:g}"}))
            if not (trial.error + self.band <= self.target and trial.seconds < FASTER * winner.seconds):
                break
            winner = trial
        return winner

    def _elements(self) -> list[str]:
        """The kinds of cells that are tried."""
        materials = [body.material for body in self.scene.bodies]
        nus = [np.max(np.asarray(own.nu, dtype=np.float64)) for own in materials if isinstance(own, HookeanMaterial)]
        averaged = max(nus, default=0.0) >= NEARLY_INCOMPRESSIBLE
        return ["linear", "quadratic", *(["averaged"] if averaged else [])]

    def _schemes(self) -> list[str]:
        """The implicit schemes that are tried."""
        schemes = [LINEARISED, *(name for name, kind in SOLVERS.items() if issubclass(kind, ImplicitSolver))]
        if self.scene.obstacles:
            schemes.remove(ImplicitMidpoint.name)
        return schemes


def coarser(mesh: MeshControl, setting: Setting, factor: int) -> Setting:
    """The setting with cells larger by a factor, or as large as there are."""
    while factor > 1:
        found = mesh.finer(setting, 1.0 / factor)
        if found is not None:
            return found
        factor //= 2
    return setting


def _with(values: Mapping[str, str], element: str) -> Setting:
    return Setting.of(**{**values, f"{FORCED}element": element})


def _least(found: Sequence[Trial]) -> float:
    return min((trial.seconds for trial in found), default=math.inf)
