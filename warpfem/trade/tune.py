"""Finds the cheapest setting of a scene within an error, without trying all.

1. A reference is built whose error band is a part of the error asked for, or the search is refused.
2. On the first part of the frames the settings are sought that may be the cheapest (:mod:`warpfem.trade.contenders`).
3. These are run to the end, and what is cheaper and may be within the error over all frames. The frames that the search
   has not seen show whether they hold; if they do not, or are far more accurate than asked, the search is repeated for
   a smaller or larger error.
4. Of the one that is left the tolerance is loosened, as far as that makes it faster and its error allows it.

Linear elasticity takes the place of another law, and equilibria that of motion, only where the difference that this
makes on a coarse mesh is a small part of the error asked for, and where it is faster. Other models, such as plane
strain, are a scene's own to offer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from warpfem.errors import SimulationError
from warpfem.solvers.implicit import ImplicitSolver
from warpfem.trade.axes import MeshControl
from warpfem.trade.components import components
from warpfem.trade.contenders import FASTER, Contenders
from warpfem.trade.front import label, percent
from warpfem.trade.ladders import Rung
from warpfem.trade.outcome import Outcome
from warpfem.trade.problem import FORCED, Setting
from warpfem.trade.reference import L2, LARGEST, Reference, relative
from warpfem.trade.study import Point, Study, difference
from warpfem.trade.trials import AIM, TINY, Trial, Trials
from warpfem.trade.tuning_reference import reference_within

SAFE = 0.95
"""The part of the error asked for that the search uses."""

SLACK = 0.65
"""Of the error asked for: a setting that is more accurate is worth another search."""

PART = 0.5
"""The part of the frames on which settings are tried."""

FEWEST_FRAMES = 8
"""Scenes of fewer frames are not divided."""

SEARCHES = 4
"""How often the search is repeated for another error."""

CLOSE_CALL = 1.5
"""Times the cost of the cheapest up to which settings are timed again before one is chosen."""


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
    reference, explicit = reference_within(study, mesh, name, target)
    total = int(study.scene.frames)
    divided = name in (L2, LARGEST) and total >= FEWEST_FRAMES
    frames = math.ceil(PART * total) if divided else total
    first = reference.ladders["space"][0]
    exact = reference.limits.get("time", first.outcome)
    coarse = replace(first.outcome, motion=exact.motion, quantities=exact.quantities)
    contenders = Contenders(
        Trials(study.shortened(frames), _part(reference.outcome, slice(frames + 1)), reference.scales, name),
        mesh,
        explicit,
        Rung(first.setting, first.size, _part(coarse, slice(frames + 1))),
    )
    whole = Trials(study, reference.outcome, reference.scales, name)
    limit = _limit(name, target, reference.band(name))
    # all of a mean square can be in the frames that are seen
    hopeless = limit * math.sqrt((total + 1) / (frames + 1)) if name == L2 else limit
    holding, ended = _search(contenders, whole, limit, hopeless, frames)
    if not holding:
        raise SimulationError(
            f"no setting within {percent(target)} of {label(name)} was found in runs of up to {study.limit:g} s"
            + "".join(f"; {trial.setting.label} is off by {percent(trial.error)}" for trial in ended)
        )
    winner = _loosened(_fastest(holding, study.alone(), repeats), whole, limit)
    (point,) = study.alone().run([winner.setting], repeats)
    seen = unseen = None
    if divided:
        seen, unseen = (
            relative(difference(_part(point.first, own), _part(reference.outcome, own)), reference.scales)[name]
            for own in (slice(frames + 1), slice(frames + 1, None))
        )
    (parts,) = components(study, mesh, reference, [point])
    errors = {kind: own[name] for kind, own in parts.items() if name in own}
    return Tuned(
        name,
        target,
        winner.setting,
        point,
        reference.errors(point.first)[name],
        seen,
        unseen,
        frames,
        reference,
        errors,
        sorted(ended, key=lambda trial: trial.seconds),
        len(contenders.tried | whole.tried.keys()),
    )


def _limit(name: str, target: float, band: float) -> float:
    """The largest error against the reference of what is taken to be within the target.

    In the root mean square, errors of the setting and of the reference, which have nothing to do with each other, add
    up as squares do.
    """
    return math.sqrt(target**2 - band**2) if name == L2 else target - band


def _part(outcome: Outcome, frames: slice) -> Outcome:
    """Some frames of an outcome."""
    return replace(outcome, times=outcome.times[frames], motion=outcome.motion[frames])


def _search(
    contenders: Contenders, whole: Trials, limit: float, hopeless: float, frames: int
) -> tuple[list[Trial], list[Trial]]:
    """Settings whose error over all frames is within a limit, and all that were run over all.

    On the first frames, none has an error above ``hopeless`` that is within the limit over all.
    """
    goal = SAFE * limit
    ended: dict[Setting, Trial] = {}
    holding: list[Trial] = []
    for _ in range(SEARCHES):
        whole.study.say(f"settings within {percent(goal)} on the first {frames} frames")
        failed = {trial.setting for trial in ended.values() if trial.point.failure}
        found = [trial for trial in contenders.within(goal, hopeless, failed) if trial.setting not in ended]
        if not found:
            break
        last = whole.run([trial.setting for trial in found])
        ended |= {trial.setting: trial for trial in last}
        # the goal at which each would be just within the limit, if the rest of the frames is as much harder for all
        just = {
            own.setting: AIM * early.error * limit / max(own.error, TINY)
            for early, own in zip(found, last, strict=True)
            if not own.point.failure
        }
        held = [trial for trial in last if trial.error <= limit]
        if holding and not held:
            break
        holding += held
        if not holding:
            goal = min(just.values(), default=goal)
            continue
        best = min(holding, key=lambda trial: trial.seconds)
        relaxed = min(just.get(best.setting, 0.0), hopeless)
        if best.error >= SLACK * limit or relaxed <= goal:
            break
        goal = relaxed
    return holding, list(ended.values())


def _fastest(holding: list[Trial], study: Study, repeats: int) -> Trial:
    """The fastest, by times of which none was disturbed by chance."""
    least = min(trial.seconds for trial in holding)
    close = [trial for trial in holding if trial.seconds <= CLOSE_CALL * least]
    points = study.run([trial.setting for trial in close], repeats)
    timed = [replace(trial, point=point) for trial, point in zip(close, points, strict=True)]
    return min(timed, key=lambda trial: trial.seconds)


def _loosened(winner: Trial, whole: Trials, limit: float) -> Trial:
    """The setting with the largest tolerance that is within the limit and makes it faster."""
    solver = whole.study.problem.build(winner.setting).scene.solver
    if not isinstance(solver, ImplicitSolver) or solver.max_iterations == 1:
        return winner  # there is no tolerance
    for factor in (10.0, 100.0):
        trial = whole.one(winner.setting.changed(**{f"{FORCED}tolerance": f"{factor * solver.tolerance:g}"}))
        if not (trial.error <= limit and trial.seconds < FASTER * winner.seconds):
            break
        winner = trial
    return winner
