"""Runs cases of the stability table and reports them as text, JSON and Markdown."""

from __future__ import annotations

import importlib.metadata
import math
import os
import platform
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path

import warpfem
from warpfem.extremes.table import Case, Status, Trial

STATUSES: tuple[Status, ...] = ("pass", "refused", "FAIL")


@dataclass(frozen=True)
class Outcome:
    """What came out of a case.

    Attributes:
        case: the case.
        trials: its trials, in the order in which they ran.
        seconds: wall time [s].
    """

    case: Case
    trials: list[Trial]
    seconds: float

    def count(self, status: Status) -> int:
        """How many trials have that status."""
        return sum(trial.status == status for trial in self.trials)

    @property
    def worst(self) -> Trial | None:
        """The trial whose figure is the largest part of its limit, or None if no trial has a figure."""
        figures = [(trial.ratio, trial) for trial in self.trials if trial.ratio is not None]
        largest = max(figures, key=lambda pair: math.inf if math.isnan(pair[0]) else pair[0], default=None)
        return largest and largest[1]


def run_case(case: Case, quick: bool) -> Outcome:
    """Runs the trials of a case. An exception that is not expected ends the case with a FAIL, as does no trial."""
    start = time.perf_counter()
    trials: list[Trial] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a case that looks for warnings records them itself
        try:
            trials.extend(case.trials(quick))
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            reason = f"{type(error).__name__}: {error} ({Path(where.filename).name}, line {where.lineno})"
            trials.append(Trial(f"trial {len(trials) + 1} and those after it", "FAIL", "crashed", reason))
    if not trials:
        trials.append(Trial("all", "FAIL", "", "the case tried nothing"))
    return Outcome(case, trials, time.perf_counter() - start)


def run_cases(numbers: Sequence[int], quick: bool, start: Callable[[], None]) -> Iterator[Outcome]:
    """Runs cases in as many processes as there are processors; yields their outcomes in the order of the numbers.

    Args:
        numbers: of the cases.
        quick: whether to try few settings.
        start: called in each process first.
    """
    workers = min(len(numbers), os.cpu_count() or 1)
    if workers == 1:
        yield from (_run_number(number, quick) for number in numbers)
        return
    with ProcessPoolExecutor(workers, get_context("spawn"), start) as pool:
        yield from pool.map(_run_number, numbers, repeat(quick))


def _run_number(number: int, quick: bool) -> Outcome:
    from warpfem.extremes import CASES  # all of them, in a process of its own too

    return run_case(CASES[number], quick)


def failed(outcomes: Sequence[Outcome]) -> int:
    """How many trials failed."""
    return sum(outcome.count("FAIL") for outcome in outcomes)


# ---- text


def text_header() -> str:
    """The head of the table that :func:`text_row` continues."""
    return f"case  {'title':<44} {'pass':>5} {'refused':>7} {'FAIL':>5} {'s':>7}  worst figure"


def text_row(outcome: Outcome) -> str:
    """A line of the table, and one for each trial that failed."""
    case, worst = outcome.case, outcome.worst
    title = case.title if len(case.title) <= 44 else f"{case.title[:41]}..."
    passed, refused, bad = (outcome.count(status) for status in STATUSES)
    row = f"{case.number:>4}  {title:<44} {passed:>5} {refused:>7} {bad:>5} {outcome.seconds:>7.1f}"
    lines = [f"{row}  {worst.measured}: {worst.setting}" if worst else row]
    for trial in outcome.trials:
        if trial.status == "FAIL":
            lines.append(f"      FAIL {trial.setting}: {'; '.join(filter(None, (trial.measured, trial.note)))}")
    return "\n".join(lines)


# ---- JSON


def json_data(outcomes: Sequence[Outcome], quick: bool) -> dict:
    """All trials with their figures, as JSON has them."""
    return {
        "versions": _versions(),
        "quick": quick,
        **_counts(outcomes),
        "cases": [
            {
                "case": outcome.case.number,
                "title": outcome.case.title,
                "criterion": outcome.case.criterion,
                "seconds": outcome.seconds,
                **_counts([outcome]),
                "trials": [_trial_data(trial) for trial in outcome.trials],
            }
            for outcome in outcomes
        ],
    }


def _counts(outcomes: Sequence[Outcome]) -> dict[str, int]:
    return {status.lower(): sum(outcome.count(status) for outcome in outcomes) for status in STATUSES}


def _trial_data(trial: Trial) -> dict:
    data = asdict(trial)
    if trial.ratio is not None and not math.isfinite(trial.ratio):
        data["ratio"] = None  # JSON knows no infinity
    return data


# ---- Markdown


def markdown(outcomes: Sequence[Outcome], quick: bool) -> str:
    """The page of figures: what every case asks, tried and found. It holds nothing that depends on the machine."""
    command = "warpfem extremes --quick" if quick else "warpfem extremes"
    versions = ", ".join(f"{name} {version}" for name, version in _versions().items())
    lines = [
        "# Stability at the extremes",
        "",
        f"Made by `{command}` with {versions}, on the CPU. A trial passes if the criterion of its case is met; it is",
        "refused if warpfem says why it will not do this, where the criterion allows that; else it has FAILED.",
        "",
        "| case | title | pass | refused | FAIL | worst figure |",
        "|---|---|---|---|---|---|",
    ]
    for outcome in outcomes:
        worst = f"{outcome.worst.measured}: {outcome.worst.setting}" if outcome.worst else ""
        counts = [str(outcome.count(status)) for status in STATUSES]
        lines.append(_row(str(outcome.case.number), outcome.case.title, *counts, worst))
    for outcome in outcomes:
        lines += ["", f"## {outcome.case.number}. {outcome.case.title}", "", outcome.case.criterion, ""]
        lines += ["| tried | result | measured | said |", "|---|---|---|---|"]
        lines += [_row(trial.setting, trial.status, trial.measured, trial.note) for trial in outcome.trials]
    return "\n".join(lines) + "\n"


def _row(*cells: str) -> str:
    return f"| {' | '.join(' '.join(cell.split()).replace('|', chr(92) + '|') for cell in cells)} |"


def _versions() -> dict[str, str]:
    versions = {"warpfem": warpfem.__version__, "Python": platform.python_version()}
    return versions | {package: importlib.metadata.version(package) for package in ("warp-lang", "numpy")}
