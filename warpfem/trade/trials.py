"""Settings that are tried one after the other, and the search for the coarsest that is accurate enough."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from warpfem.trade.outcome import Outcome
from warpfem.trade.problem import FORCED, Setting
from warpfem.trade.reference import relative
from warpfem.trade.study import Point, Study, difference

AIM = 0.92
"""The part of an error's goal that a search aims at."""

HOPE = 1.1
"""The part of the goal up to which a coarser level is tried where there is none between."""

CLOSE = 0.8
"""The part of the goal above which a setting that meets it is coarse enough."""

LEAST_FACTOR, MOST_FACTOR = 1.15, 2.5
"""By how much a level is finer than one that was not accurate enough."""

TINY = 1e-12
"""Errors are none below."""

LARGER = (1.5, 2.0)
"""What is tried where that is less than one cell."""

STAGNANT = 0.9
"""The part of an error to which refinement brings it down at least."""

MOST_TRIALS = 8
"""Levels of a search."""

Finer = Callable[[Setting, float], Setting | None]
"""A setting finer by about a factor, or coarser by one below 1; ``None`` if there is none."""


@dataclass(frozen=True, eq=False)
class Trial:
    """A setting that was run.

    Attributes:
        setting: the setting.
        point: its runs.
        error: relative, against the reference; infinite if it failed.
    """

    setting: Setting
    point: Point
    error: float

    @property
    def outcome(self) -> Outcome:
        """Of its first run without failure."""
        return self.point.first

    @property
    def seconds(self) -> float:
        """Wall time of its steps; infinite if it failed."""
        return math.inf if self.point.failure else self.point.seconds


class Trials:
    """Runs settings and compares them with a reference.

    Args:
        study: runs settings.
        reference: what they are compared with.
        scales: what errors are relative to, by name.
        name: of the norm or quantity.
    """

    def __init__(self, study: Study, reference: Outcome, scales: dict[str, float], name: str) -> None:
        self.study = study
        self.reference = reference
        self.scales = scales
        self.name = name
        self.tried: dict[Setting, Trial] = {}

    def run(self, settings: Sequence[Setting]) -> list[Trial]:
        """Tries settings; what float32 does not resolve, in float64."""
        points = self.study.run(settings)
        again = {p.setting: p.setting.changed(dtype="float64") for p in points if _asks_for_digits(p)}
        wider = dict(zip(again, self.study.run(list(again.values())), strict=True))
        trials = [self._trial(wider.get(point.setting, point)) for point in points]
        self.tried |= dict(zip(settings, trials, strict=True))
        return trials

    def one(self, setting: Setting) -> Trial:
        """Tries a setting."""
        (trial,) = self.run([setting])
        return trial

    def against(self, reference: Outcome) -> Trials:
        """The same settings, compared with another reference."""
        return Trials(self.study, reference, self.scales, self.name)

    def _trial(self, point: Point) -> Trial:
        if point.failure:
            return Trial(point.setting, point, math.inf)
        errors = relative(difference(point.first, self.reference), self.scales)
        return Trial(point.setting, point, errors.get(self.name, math.inf))


def _asks_for_digits(point: Point) -> bool:
    return "float32" in point.failure and "dtype" not in point.setting


def coarsest_within(
    run: Callable[[Setting], Trial],
    start: Setting,
    finer: Finer,
    resolution: Callable[[Trial], float],
    *,
    goal: float,
    order: float,
    growth: float,
    most_seconds: float = math.inf,
) -> Trial | None:
    """The coarsest level of a sequence of settings whose error is within a goal, or one little finer.

    Levels are guessed from E ~ resolution^-p, with p from the two levels next to the goal. Where errors no longer fall,
    the search goes on in float64 if that helps.

    Args:
        run: tries a setting.
        start: the first level.
        finer: makes other levels of one.
        resolution: of a level that did not fail, such as 1 / h.
        goal: the largest error.
        order: the p that is expected.
        growth: the power of the resolution with which cost grows.
        most_seconds: the search ends without result where a level would take longer.
    """
    tried: list[Trial] = []
    following: Setting | None = start
    rounded = math.inf  # the error that no refinement has brought down in float32
    while following is not None and following not in {t.setting for t in tried} and len(tried) < MOST_TRIALS:
        trial = run(following)
        tried.append(replace(trial, setting=following))
        good = [t for t in tried if t.error <= goal]
        if not good:
            if trial.point.failure:
                following = finer(following, 2.0) if len(tried) < 3 else None
                continue
            factor = _step(tried, resolution, goal, order)
            if trial.seconds * factor**growth > most_seconds or trial.error > STAGNANT * rounded:
                return None
            if _stagnates(tried):
                if "dtype" in following:
                    return None
                following, tried, rounded = following.changed(dtype="float64"), [], trial.error
                continue
            following = next(filter(None, (finer(following, own) for own in (factor, *LARGER) if own >= factor)), None)
            continue
        best = min(good, key=resolution)
        if best.error >= CLOSE * goal:
            break
        lower = [t for t in tried if t.error > goal and math.isfinite(t.error) and resolution(t) < resolution(best)]
        p = order
        if lower:
            last = max(lower, key=resolution)
            p = math.log(last.error / max(best.error, TINY)) / math.log(resolution(best) / resolution(last))
        factors = (max(0.4, (best.error / (part * goal)) ** (1.0 / p)) for part in (AIM, HOPE))
        following = next(filter(None, (finer(best.setting, own) for own in factors)), None)
    good = [t for t in tried if t.error <= goal]
    if not good:
        return None
    chosen = min(good, key=lambda t: t.seconds)
    return replace(chosen, setting=chosen.point.setting)


def _stagnates(tried: Sequence[Trial]) -> bool:
    """Whether the last of three levels is hardly more accurate than those before: something else makes the error."""
    return len(tried) > 2 and tried[-1].error > STAGNANT * min(trial.error for trial in tried[-3:-1])


def _step(tried: Sequence[Trial], resolution: Callable[[Trial], float], goal: float, order: float) -> float:
    """How much finer than the last level the next one shall be."""
    last, p = tried[-1], order
    if len(tried) > 1 and math.isfinite(tried[-2].error) and resolution(last) > resolution(tried[-2]):
        gain = math.log(tried[-2].error / max(last.error, TINY))
        observed = gain / math.log(resolution(last) / resolution(tried[-2]))
        p = min(max(observed, 0.6 * order), 1.5 * order)
    return min(max((last.error / (AIM * goal)) ** (1.0 / p), LEAST_FACTOR), MOST_FACTOR)


# ---- levels in time


def with_steps(setting: Setting, fps: float, steps: int) -> Setting:
    """The setting with that many steps of a frame."""
    return setting.changed(**{f"{FORCED}dt": f"1/{fps * steps:.12g}"})


def steps_of(setting: Setting, fps: float) -> int:
    """How many steps of a frame a setting has that :func:`with_steps` has made."""
    return round(float(setting[f"{FORCED}dt"].partition("/")[2]) / fps)


def finer_in_time(fps: float) -> Finer:
    """Levels of whole steps of a frame."""

    def finer(setting: Setting, factor: float) -> Setting | None:
        old = steps_of(setting, fps)
        new = max(old + 1, round(factor * old)) if factor > 1.0 else max(1, round(factor * old))
        return None if new == old else with_steps(setting, fps, new)

    return finer
