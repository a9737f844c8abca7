"""What a case of the stability table is: a criterion, and trials of it in many settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

from warpfem.errors import WarpfemError

Status: TypeAlias = Literal["pass", "refused", "FAIL"]


@dataclass(frozen=True)
class Trial:
    """One setting of a case.

    Attributes:
        setting: what was tried, for example "NeoHookean, 3D, float32".
        status: "pass" if the criterion is met, "refused" if warpfem said clearly why it will not do this, where
            the criterion allows that; else "FAIL".
        measured: what was found, with its unit.
        note: the refusal's message, or what went wrong.
        ratio: the figure over its limit, by which the worst trial of a case is found; ``None`` without a figure.
    """

    setting: str
    status: Status
    measured: str = ""
    note: str = ""
    ratio: float | None = None


@dataclass(frozen=True)
class Case:
    """A row of the table.

    Attributes:
        number: its place in the table.
        title: what is done.
        criterion: what has to come out.
        trials: ``trials(quick)`` tries the settings one by one; quick ones take few settings and small meshes.
    """

    number: int
    title: str
    criterion: str
    trials: Callable[[bool], Iterator[Trial]]


CASES: dict[int, Case] = {}
"""All cases by number."""


def case(number: int, title: str, criterion: str) -> Callable:
    """Decorates the function that yields the trials of a case."""

    def register(trials: Callable[[bool], Iterator[Trial]]) -> Callable[[bool], Iterator[Trial]]:
        CASES[number] = Case(number, title, criterion, trials)
        return trials

    return register


def at_most(setting: str, value: float, limit: float, unit: str = "") -> Trial:
    """A trial that passes if ``value`` is a number of at most ``limit``."""
    passed = value <= limit  # false for a value that is not a number
    ratio = value / limit if limit > 0.0 else 0.0 if passed else math.inf
    return Trial(setting, "pass" if passed else "FAIL", f"{value:.2g}{unit} (limit {limit:.2g}{unit})", ratio=ratio)


def refused(setting: str, action: Callable[[], object], *words: str) -> Trial:
    """A trial that ``action`` must refuse by a :class:`WarpfemError` whose message holds all ``words``."""
    try:
        result = action()
    except WarpfemError as error:
        missing = [word for word in words if word not in str(error)]
        if missing:
            return Trial(setting, "FAIL", "unclear", f"the message lacks {', '.join(missing)}: {error}")
        return Trial(setting, "refused", "", str(error))
    return Trial(setting, "FAIL", "accepted", f"no error, but {result!r}")


def attempted(setting: str, trial: Callable[[], Trial]) -> Trial:
    """The trial that ``trial`` makes; a FAIL if it is refused, so that the trials after it still run."""
    try:
        return trial()
    except WarpfemError as error:
        return Trial(setting, "FAIL", "stopped", f"{type(error).__name__}: {error}")
