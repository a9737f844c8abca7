"""The outcomes of the cases as lines of text and as a page of Markdown, neither with anything of the machine."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Sequence

from verification.core import Outcome


def text(outcome: Outcome) -> str:
    """A line for the case, and one for each check that failed."""
    passed = len(outcome.checks) - len(outcome.failures)
    lines = [f"{outcome.case.name:<14} {passed:>4} passed {len(outcome.failures):>4} FAILED {outcome.seconds:>8.1f} s"]
    lines += [f"    FAIL {check.what}: {check.measured} ({check.required})" for check in outcome.failures]
    return "\n".join(lines)


def markdown(outcomes: Sequence[Outcome], quick: bool) -> str:
    """The page: what every case computes, compares with, requires and found."""
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("warp-lang", "numpy", "scipy"))
    command = "python benchmarks/verification" + (" --quick" if quick else "")
    lines = [
        "# Accuracy",
        "",
        f"Made by `{command} --out docs/accuracy.md` with {versions}, on the CPU in float64. Each case says what it",
        "computes, what it is compared with and where that comes from, and what must come out. Lengths are in metres,",
        "stresses in pascals; 2D is plane strain.",
        "",
        "| case | subject | passed | FAILED |",
        "|---|---|---|---|",
    ]
    for outcome in outcomes:
        case, failed = outcome.case, len(outcome.failures)
        link = f"[{case.name}](#{_anchor(case.title)})"
        lines.append(_row([link, case.title, str(len(outcome.checks) - failed), str(failed)]))
    for outcome in outcomes:
        case = outcome.case
        lines += ["", f"## {case.title}", "", case.what, "", f"*Reference:* {case.reference}", ""]
        lines += [f"*Criterion:* {case.criterion}", ""]
        for table in outcome.tables:
            lines += [f"{table.title}:", "", _row(table.head), _row(["---"] * len(table.head))]
            lines += [*map(_row, table.rows), ""]
        lines += ["| checked | measured | required | |", "|---|---|---|---|"]
        lines += [_row([c.what, c.measured, c.required, "PASS" if c.passed else "FAIL"]) for c in outcome.checks]
    return "\n".join(lines) + "\n"


def _anchor(title: str) -> str:
    kept = "".join(c for c in title.lower() if c.isalnum() or c in " -")
    return kept.replace(" ", "-")


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(' '.join(cell.split()).replace('|', chr(92) + '|') for cell in cells)} |"
