"""What a case of the verification suite is, and what it reports: checks with bounds, and tables of figures."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Check:
    """One criterion, met or not.

    Attributes:
        what: what was measured.
        measured: the figure.
        required: the bound in words.
        passed: whether it holds.
    """

    what: str
    measured: str
    required: str
    passed: bool


@dataclass(frozen=True)
class Table:
    """Figures without a criterion of their own.

    Attributes:
        title: what they are.
        head: the names of the columns.
        rows: the cells as text.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Case:
    """A subject of the suite.

    Attributes:
        name: what ``--case`` takes.
        title: the heading.
        what: what is computed.
        reference: what it is compared with, and the source of that.
        criterion: what has to come out.
        run: ``run(quick)`` yields checks and tables; quick ones take coarse meshes and few settings.
    """

    name: str
    title: str
    what: str
    reference: str
    criterion: str
    run: Callable[[bool], Iterator[Check | Table]]


@dataclass(frozen=True)
class Outcome:
    """What a case came to.

    Attributes:
        case: the case.
        checks: in the order in which they were made.
        tables: likewise.
        seconds: wall time [s].
    """

    case: Case
    checks: list[Check]
    tables: list[Table]
    seconds: float

    @property
    def failures(self) -> list[Check]:
        """The checks that failed."""
        return [check for check in self.checks if not check.passed]


def at_most(what: str, measured: float, limit: float) -> Check:
    """A check that passes if the figure is a number of at most ``limit``."""
    return Check(what, f"{measured:.2g}", f"at most {limit:.2g}", measured <= limit)  # false for NaN


def between(what: str, measured: float, low: float, high: float) -> Check:
    """A check that passes if ``low <= measured <= high``."""
    return Check(what, f"{measured:.4g}", f"{low:.4g} to {high:.4g}", low <= measured <= high)


def holds(what: str, passed: bool, measured: str, required: str) -> Check:
    """A check of anything else."""
    return Check(what, measured, required, bool(passed))


def run_case(case: Case, quick: bool) -> Outcome:
    """Runs a case. An exception ends it with a failed check, and so does a case without checks."""
    start = time.perf_counter()
    checks: list[Check] = []
    tables: list[Table] = []
    try:
        for item in case.run(quick):
            if isinstance(item, Check):
                checks.append(item)
            else:
                tables.append(item)
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        said = f"{type(error).__name__}: {error} ({Path(where.filename).name}, line {where.lineno})"
        checks.append(Check("the rest of the case", said, "no error", False))
    if not checks:
        checks.append(Check("the case", "checks nothing", "at least one check", False))
    return Outcome(case, checks, tables, time.perf_counter() - start)


def orders(sizes: Sequence[float], errors: Sequence[float]) -> list[float]:
    """The order of convergence between each size of cells and the next."""
    from math import log

    pairs = zip(zip(sizes, errors, strict=True), zip(sizes[1:], errors[1:], strict=False), strict=False)
    return [log(e / f) / log(h / k) for (h, e), (k, f) in pairs]
