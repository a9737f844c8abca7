"""The front of a study: the settings that no other one beats in both time and error, and what they answer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from warpfem.trade.reference import Reference
from warpfem.trade.study import Point

NEXT = 10.0
"""The factor of accuracy whose price is told."""

RESOLVED = 0.25
"""The largest part of an error that the reference's band may be for the error to be more than a bound."""


TAIL = 10.0
"""Errors over the smallest one of a front that belong to the part that is extrapolated."""

LEAST_TAIL = 3
"""Settings of a front, if it has so many, that belong to that part whatever their errors."""


DECISIVE = 0.25
"""The part of the reference's band from which on what leaves it is told as a reason."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A setting with its cost and its error.

    Attributes:
        point: the setting and its runs.
        error: relative, against the reference.
        band: what the error may be off by: the reference's.
    """

    point: Point
    error: float
    band: float

    @property
    def seconds(self) -> float:
        """Wall time of its steps [s]."""
        return self.point.seconds

    @property
    def bound(self) -> float:
        """The largest that the error may be."""
        return self.error + self.band

    @property
    def resolved(self) -> bool:
        """Whether the error is more than a bound."""
        return self.band <= RESOLVED * self.error


def candidates(points: Sequence[Point], reference: Reference, name: str) -> list[Candidate]:
    """The settings that have an error of that name, from the fastest to the slowest."""
    band = reference.band(name)
    found = [(point, reference.errors(point.first).get(name)) for point in points if not point.failure]
    known = [Candidate(point, error, band) for point, error in found if error is not None]
    return sorted(known, key=lambda own: (own.seconds, own.error))


def front(ordered: Sequence[Candidate]) -> list[Candidate]:
    """Those that are more accurate than all faster ones."""
    kept: list[Candidate] = []
    for candidate in ordered:
        if not kept or candidate.error < kept[-1].error:
            kept.append(candidate)
    return kept


@dataclass(frozen=True, eq=False)
class Answer:
    """The cheapest setting within an error, and the price of the next factor of ten.

    Attributes:
        name: of the norm or quantity.
        target: the relative error asked for.
        refusal: why there is no answer; empty if there is one.
        candidate: the cheapest setting within the error; ``None`` if none is.
        closest: the most accurate setting, where none is.
        next_seconds: time of a setting within a tenth of the error [s]; where none is within the error, of one within
            it; ``None`` if the front does not tell.
        next_how: whether that was measured or extrapolated along the front.
        next_unknown: why the front does not tell; empty if it does.
    """

    name: str
    target: float
    refusal: str = ""
    candidate: Candidate | None = None
    closest: Candidate | None = None
    next_seconds: float | None = None
    next_how: Literal["measured", "extrapolated", ""] = ""
    next_unknown: str = ""

    @property
    def sentence(self) -> str:
        """The answer for people."""
        asked = f"{percent(self.target)} of {label(self.name)}"
        if self.refusal:
            return f"No answer for {asked}: {self.refusal}"
        price = f"the front does not tell what that costs: {self.next_unknown}"
        if self.next_seconds is not None:
            price = (
                f"{'about ' if self.next_how == 'extrapolated' else ''}{rounded(self.next_seconds)} s ({self.next_how})"
            )
        if self.candidate is None:
            assert self.closest is not None
            return (
                f"No setting of the sweep is within {asked}: the most accurate, {self.closest.point.setting.label}, is "
                f"off by {percent(self.closest.error)} (± {percent(self.closest.band)}) and takes "
                f"{rounded(self.closest.seconds)} s; to get there: {price}"
            )
        own = self.candidate
        least, most = own.point.spread
        if self.next_seconds == own.seconds:
            price = "it is within that, too"
        elif self.next_seconds is not None:
            price += f", {rounded(self.next_seconds / own.seconds)} times as much"
        within = "known to be within" if own.band > RESOLVED * self.target else "within"
        return (
            f"The cheapest setting {within} {asked} is {own.point.setting.label}: {rounded(own.seconds)} s "
            f"({rounded(least)} to {rounded(most)} s), off by {percent(own.error)} (± {percent(own.band)}); "
            f"the next factor of {NEXT:g}: {price}"
        )


def answer(ordered: Sequence[Candidate], reference: Reference, name: str, target: float) -> Answer:
    """The cheapest setting that is known to be within an error.

    There is no answer where none is known to be, but some may: where the reference does not tell.

    Args:
        ordered: the settings, from fast to slow.
        reference: that of their errors.
        name: of the norm or quantity.
        target: the relative error asked for.
    """
    band = reference.band(name)
    if not ordered:
        return Answer(name, target, "every setting failed, or has no value of it")
    within = [own for own in ordered if own.bound <= target]
    outside = all(own.error - own.band > target for own in ordered)
    if not within and not outside and not band <= RESOLVED * target:
        return Answer(name, target, f"the reference itself may be off by {percent(band)}. {advice(reference, name)}")
    edge = front(ordered)
    goal = target / NEXT if within else target
    measured = [own for own in ordered if own.bound <= goal]
    seconds, unknown = (measured[0].seconds, "") if measured else _extrapolated(edge, goal)
    how: Literal["measured", "extrapolated", ""] = "measured" if measured else "" if unknown else "extrapolated"
    priced = Answer(name, target, next_seconds=seconds, next_how=how, next_unknown=unknown)
    if within:
        return replace(priced, candidate=within[0])
    return replace(priced, closest=min(ordered, key=lambda own: own.error))


def advice(reference: Reference, name: str) -> str:
    """Why a reference is not more accurate, and what to do."""
    parts, most = reference.parts[name], DECISIVE * reference.band(name)
    reasons = [f"in {kind}: {part.remark}" for kind, part in parts.items() if part.remark and part.band >= most]
    reasons += list(dict.fromkeys(reference.remarks))
    text = f"Reasons: {'; '.join(reasons)}. " if reasons else ""
    return (
        f"{text}Motion that small changes alter for good, such as that after impacts, has no reference: take fewer "
        "--frames, a quantity that is less sensitive, or more damping; else allow longer runs by --limit"
    )


def _extrapolated(edge: Sequence[Candidate], goal: float) -> tuple[float | None, str]:
    """The time at which the front, continued as a power law from its last part, comes to an error [s], or why not.

    Errors that the reference does not resolve follow no power law, but where the last setting has cost more than the
    law says, so will what is beyond. Where that setting may be within the goal, others need not be looked for.
    """
    if edge[-1].error <= goal:
        return None, f"its last setting may be within {percent(goal)}, but the reference does not resolve that"
    resolved = [own for own in edge if own.resolved]
    tail = [own for own in resolved if own.error <= TAIL * resolved[-1].error]
    tail = tail if len(tail) >= LEAST_TAIL else resolved[-LEAST_TAIL:]
    if len(tail) < 2:
        return None, "it has too few settings whose errors the reference resolves"
    logs = np.log([[own.error, own.seconds] for own in tail])
    slope, _ = np.polyfit(logs[:, 0], logs[:, 1], 1)

    def law(error: float) -> float:
        return math.exp(logs[-1, 1] + slope * (math.log(error) - logs[-1, 0]))

    last = edge[-1]
    return law(goal) * max(1.0, last.seconds / law(last.error if last.resolved else last.bound)), ""


def percent(value: float) -> str:
    """A relative error for people."""
    return f"{rounded(100.0 * value)} %"


def rounded(value: float) -> str:
    """A number for people, to two digits but never without its units."""
    return f"{value:.0f}" if value >= 99.5 else f"{value:.2g}"


def label(name: str) -> str:
    """What an error is of, for people."""
    return {"l2": "the motion (L2)", "max": "the motion (largest)"}.get(name, f"'{name}'")
