"""A plot of a run's log: energies, displacements, stress and volume over time."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpfem.errors import MissingExtraError, OutputError, one_line
from warpfem.files import beside, replacing, require_writable
from warpfem.log_file import (
    ENERGIES,
    LEAST_J,
    STEPS,
    STRESS,
    SUFFIXES,
    TIME,
    UNCONVERGED,
    LogTable,
    energy,
    read_log,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Told apart by all (Okabe and Ito 2008)."""

PICTURES = (".png", ".svg")

_ENERGY_COLORS = dict(zip(ENERGIES, (*COLORS[:4], "black"), strict=True))
_DISPLACEMENTS = tuple(f" u{axis} [m]" for axis in "xyz")
_VISIBLE = 0.02
"""The part of the largest displacement below which one sees no difference."""
_FEW = 40
"""Frames up to which each is marked."""


def plot(run: str | Path, out: str | Path | None = None, *, curves: Sequence[str] = ()) -> Path:
    """Draws the log of a run.

    Panels show the energies, the displacements of bodies and point sets, the largest von Mises stress, and the least
    J, each over time. Of many displacements those are drawn that change most.

    Args:
        run: a log, ``.csv`` or ``.jsonl``, or a USD file that has its log beside it, under the same name.
        out: the picture, ``.png`` or ``.svg``; ``None``: ``NAME.plot.png`` beside the log.
        curves: draw only displacements whose names contain one of these texts.

    Returns:
        The path of the picture.

    Raises:
        OutputError: there is no log, it is damaged or has no frames, no displacement has such a name, or the picture
            cannot be written.
        MissingExtraError: Matplotlib is not installed.
    """
    log = log_of(run)
    out = beside(log, "plot.png") if out is None else Path(out)
    if out.suffix not in PICTURES:
        raise OutputError(f"{out}: the name of a plot must end in {' or '.join(PICTURES)}")
    require_writable(out)
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("the plot", "matplotlib", "plot") from error
    table = read_log(log)
    if not len(table.values):
        raise OutputError(f"the log {log} has no frames yet")
    figure = draw(table, _chosen(log, table, curves), log.stem)
    try:
        with replacing(out) as temporary:
            figure.savefig(temporary, format=out.suffix[1:])
    except OSError as error:
        raise OutputError(f"{out} cannot be written: {error}") from error
    return out


def log_of(run: str | Path) -> Path:
    """The log that is meant."""
    if not isinstance(run, str | os.PathLike):
        raise OutputError(f"a run must be given as a str or a path, not {run!r}")
    run = Path(run)
    if run.suffix in SUFFIXES:
        return run
    stem = run.stem.removesuffix(".partial")
    candidates = [run.with_name(stem + suffix) for suffix in SUFFIXES] if run.name else []
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    looked = f", and neither {' nor '.join(map(str, candidates))} is there" if candidates else ""
    raise OutputError(f"{run} is no log{looked}: `warpfem run SCENE --log FILE.csv` writes one")


def _chosen(log: Path, table: LogTable, curves: Sequence[str]) -> dict[str, np.ndarray]:
    """The displacements to draw, by their names, and in their order."""
    found = {name: table.column(name) for name in table.names if name.endswith(_DISPLACEMENTS)}
    if not curves:
        return found
    chosen = {name: values for name, values in found.items() if any(text in name for text in curves)}
    if not chosen:
        asked = " or ".join(map(repr, curves))
        known = one_line(", ".join(found))
        raise OutputError(f"the log {log} has no displacement with {asked} in its name: it has {known}")
    return chosen


def draw(table: LogTable, displacements: Mapping[str, np.ndarray], name: str) -> Figure:
    """A figure of what a log holds.

    Args:
        table: the log, with at least one frame.
        displacements: columns of it, of which those are drawn that can be told apart.
        name: of the run.
    """
    from matplotlib.figure import Figure

    energies = {part: table.column(energy(part)) for part in ENERGIES}
    shown = _telling(displacements)
    panels: dict[str, Mapping[str, np.ndarray]] = {
        "energy [J]": {part: values for part, values in energies.items() if values.any() or part == "total"},
        "displacement [m]": shown,
        STRESS: {"": table.column(STRESS)},
        LEAST_J: {"": table.column(LEAST_J)},
    }
    figure = Figure(figsize=(9.0, 0.6 + 2.2 * len(panels)), dpi=120, layout="constrained")
    every_axes = figure.subplots(len(panels), 1, sharex=True)
    for axes, (label, lines) in zip(every_axes, panels.items(), strict=True):
        _draw_panel(axes, table.column(TIME), label, lines)
    if len(shown) < len(displacements):
        text = f"{len(shown)} of {len(displacements)}: others\nlook alike or move less"
        every_axes[1].get_legend().set_title(text, prop={"size": "small"})
    figure.align_ylabels()
    every_axes[-1].set_xlabel(TIME)
    figure.suptitle(f"{name}: {_facts(table)}", fontsize="medium")
    return figure


def _telling(displacements: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The displacements that change most, without those that look like one of them."""
    spans = {name: float(np.ptp(values)) for name, values in displacements.items()}
    least = _VISIBLE * max(spans.values(), default=0.0)
    chosen: dict[str, np.ndarray] = {}
    for name in sorted(spans, key=lambda name: -spans[name]):
        others = chosen.values()
        differs = all(np.abs(displacements[name] - other).max() > least for other in others) and spans[name] > least
        if len(chosen) < len(COLORS) and (differs or not chosen):
            chosen[name] = displacements[name]
    return {name: values for name, values in displacements.items() if name in chosen}


def _draw_panel(axes: Axes, times: np.ndarray, label: str, lines: Mapping[str, np.ndarray]) -> None:
    """Draws lines of the same unit."""
    from matplotlib.ticker import EngFormatter

    name, _, unit = label.removesuffix("]").partition(" [")
    for (own, values), color in zip(lines.items(), COLORS * len(lines), strict=False):
        color = _ENERGY_COLORS.get(own, color)
        style = "--" if own == "total" else "-"
        text = own.removesuffix(" [m]")
        axes.plot(times, _finite(values), style, color=color, label=text, marker="." if len(times) <= _FEW else "")
    axes.set_ylabel(name)
    if unit:
        axes.yaxis.set_major_formatter(EngFormatter(unit))
    else:
        axes.ticklabel_format(useOffset=False)
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    axes.margins(x=0.01)
    if lines and "" not in lines:
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small", frameon=False)


def _finite(values: np.ndarray) -> np.ndarray:
    """The values, with a gap where one is not finite."""
    return np.where(np.isfinite(values), values, np.nan)


def _facts(table: LogTable) -> str:
    """What kind of run it was."""
    steps, unconverged = (table.column(name)[-1] for name in (STEPS, UNCONVERGED))
    remark = f", {unconverged:.0f} of them NOT CONVERGED" if unconverged > 0.0 else ""
    return f"{len(table.values)} frames, {steps:.0f} steps{remark}"
