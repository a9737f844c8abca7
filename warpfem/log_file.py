"""The two formats of logs: a line per frame, as CSV with a head or as JSON objects."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpfem.errors import OutputError
from warpfem.files import require_writable

SUFFIXES = (".csv", ".jsonl")
ENERGIES = ("kinetic", "elastic", "load", "contact", "total")
FRAME, TIME, STRESS, LEAST_J = "frame", "time [s]", "largest von Mises stress [Pa]", "least J"
STEPS, UNCONVERGED = "steps", "unconverged steps"


def energy(part: str) -> str:
    """The name of the column of one of ``ENERGIES``."""
    return f"{part} energy [J]"


FIGURES = (
    FRAME,
    TIME,
    *map(energy, ENERGIES),
    STRESS,
    LEAST_J,
    "penetration [m]",
    STEPS,
    "Newton iterations",
    "CG iterations",
    UNCONVERGED,
)
"""The columns that every log has; others follow."""


@dataclass(frozen=True, eq=False)
class LogTable:
    """What a log holds.

    Attributes:
        names: of the columns; a unit comes last, in brackets.
        values: (frames, columns) float64.
        lines: those of the file, each with its end, the head included.
    """

    names: tuple[str, ...]
    values: np.ndarray
    lines: list[str]

    def column(self, name: str) -> np.ndarray:
        """The values of a column (frames,)."""
        return self.values[:, self.names.index(name)]


def check_log_path(path: str | Path) -> None:
    """Checks what can be told of a log without writing anything.

    Raises:
        OutputError: a name without one of ``SUFFIXES``, a folder, or a file that cannot be written.
    """
    if Path(path).suffix not in SUFFIXES:
        raise OutputError(f"{str(path)!r}: the name of a log must end in {' or '.join(SUFFIXES)}")
    require_writable(Path(path))


def head(path: Path, names: Sequence[str]) -> str:
    """What a log begins with."""
    return _csv_line(names) if path.suffix == ".csv" else ""


def row(path: Path, names: Sequence[str], values: Sequence[float]) -> str:
    """The line of a frame. JSON knows no numbers that are not finite: they become null."""
    if path.suffix == ".csv":
        return _csv_line(values)
    return json.dumps({n: v if math.isfinite(v) else None for n, v in zip(names, values, strict=True)}) + "\n"


def _csv_line(values: Sequence[object]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(values)
    return line.getvalue()


def read_log(path: str | Path) -> LogTable:
    """Reads a log, also while it is being written, and without what a kill left of a last line.

    Raises:
        OutputError: a file that is missing, unreadable, or no log.
    """
    path = Path(path)
    try:
        *lines, _ = path.read_text(encoding="utf-8").split("\n")
    except (OSError, ValueError) as error:  # ValueError: no text, or a name that is none
        raise OutputError(f"the log {path} cannot be read: {error}") from None
    try:
        names, rows = _csv_rows(lines) if path.suffix == ".csv" else _json_rows(lines)
        lacking = [name for name in FIGURES if name not in names]
        if lines and lacking:
            raise ValueError(f"it has no column '{lacking[0]}'")
        values = np.array(rows, dtype=np.float64).reshape(len(rows), len(names))
        table = LogTable(names, values, [line + "\n" for line in lines])
        if rows and not np.array_equal(table.column(FRAME), np.arange(len(rows))):
            raise ValueError("its frames are not 0, 1, 2 and so on")
    except (ValueError, TypeError, RecursionError, csv.Error) as error:
        raise OutputError(f"{path} is no log of a run, or damaged: {error}") from None
    return table


def _csv_rows(lines: Sequence[str]) -> tuple[tuple[str, ...], list[list[float]]]:
    names, *rows = list(csv.reader(lines)) or [[]]
    for number, own in enumerate(rows, start=2):
        if len(own) != len(names):
            raise ValueError(f"line {number} has {len(own)} entries, the first one {len(names)}")
    return tuple(names), [[float(text) for text in own] for own in rows]


def _json_rows(lines: Sequence[str]) -> tuple[tuple[str, ...], list[list[float]]]:
    rows = [json.loads(line) for line in lines]
    names = tuple(rows[0]) if rows and isinstance(rows[0], dict) else ()
    for number, own in enumerate(rows, start=1):
        if not isinstance(own, dict) or tuple(own) != names:
            raise ValueError(f"line {number} is not an object with the keys of the first one")
    return names, [[math.nan if value is None else float(value) for value in own.values()] for own in rows]
