"""The plot of a study: time against error, on logarithmic axes."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import Any

from warpfem.errors import MissingExtraError, OutputError
from warpfem.plot import COLORS
from warpfem.trade.front import Candidate, label, percent
from warpfem.trade.report import failure_lines
from warpfem.trade.sweep import Sweep

MARKERS = ("o", "s", "^", "D", "v", "P")

MOST_LISTED = 12
"""Reasons of failures that are listed."""


def plot(own: Sweep, folder: Path) -> list[Path]:
    """Draws ``trade.png`` and ``trade.svg``.

    Raises:
        MissingExtraError: matplotlib is not installed.
        OutputError: they cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("the plot", "matplotlib", "plot") from None
    figure = Figure(figsize=(9.6, 8.4), layout="constrained")
    upper, lower = figure.subplots(2, 1, height_ratios=(2.6, 1.0))
    _draw(upper, own)
    _list(lower, own)
    paths = plots(folder)
    try:
        for path in paths:
            figure.savefig(path, dpi=150)
    except OSError as error:
        raise OutputError(f"cannot write to {folder}: {error.strerror or error}") from None
    return paths


def plots(folder: Path) -> list[Path]:
    """The files that :func:`plot` draws."""
    return [folder / "trade.png", folder / "trade.svg"]


def _draw(axes: Any, own: Sweep) -> None:
    colored, marked = _styled(own)
    for candidate in own.ordered:
        setting = candidate.point.setting
        least, most = candidate.point.spread
        axes.errorbar(
            candidate.seconds,
            candidate.error,
            xerr=[[candidate.seconds - least], [most - candidate.seconds]],
            color=_style(setting.get(colored, ""), _values(own, colored), COLORS),
            marker=_style(setting.get(marked, ""), _values(own, marked), MARKERS),
            markersize=7,
            alpha=1.0 if candidate in own.front else 0.45,
            linewidth=1.0,
            capsize=2.0,
        )
    edge = own.front
    axes.plot([c.seconds for c in edge], [c.error for c in edge], color="0.3", linewidth=1.2, zorder=0)
    for number, candidate in enumerate(edge, start=1):
        axes.annotate(
            str(number),
            (candidate.seconds, candidate.error),
            xytext=(-6, -6),
            textcoords="offset points",
            ha="right",
            va="top",
            fontweight="bold",
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    bottom, top = axes.get_ylim()
    band = 0.0 if own.reference is None else own.reference.band(own.name)
    if band > 0.0:
        axes.axhspan(min(bottom, 0.5 * band), band, color="0.85", zorder=-1)
        axes.text(0.01, band, "the reference is no better than this", va="top", transform=_across(axes))
        bottom = min(bottom, 0.5 * band)
    for target in (answer.target for answer in own.answers):
        if bottom < target < top:
            axes.axhline(target, color="0.6", linewidth=0.8, linestyle=":")
            axes.text(0.99, target, percent(target), ha="right", va="bottom", color="0.4", transform=_across(axes))
    axes.set_ylim(bottom, top)
    axes.grid(which="major", color="0.92")
    axes.set_axisbelow(True)
    load = ", other settings running too" if own.study.load == "parallel" else ""
    axes.set_xlabel(f"wall time of the steps [s]: median and range of the processes{load}")
    axes.set_ylabel(f"relative error of {label(own.name)}")
    axes.set_title(f"{Path(own.study.problem.path).stem}: time against error")
    # where nothing is as fast and as accurate, above the band
    _legend(axes, own, colored, marked, low=math.log(max(band, bottom) / bottom, top / bottom))


def _styled(own: Sweep) -> tuple[str, str]:
    """The axes that colours and markers show: words first, since their order means nothing."""
    varied = [axis for axis in own.axes if 1 < len(axis.values) <= len(COLORS)]
    words = [axis.name for axis in varied if not all(_is_number(value) for value in axis.values)]
    numbers = [axis.name for axis in varied if axis.name not in words]
    first, second, *_ = [*words, *numbers, "", ""]
    return first, second


def _is_number(text: str) -> bool:
    return all(part.replace(".", "", 1).replace("e-", "", 1).isdigit() for part in text.split("/"))


def _values(own: Sweep, name: str) -> tuple[str, ...]:
    return next((axis.values for axis in own.axes if axis.name == name), ())


def _style(value: str, values: tuple[str, ...], styles: tuple[str, ...]) -> str:
    return styles[values.index(value)] if value in values else styles[0]


def _across(axes: Any) -> Any:
    """Places across the axes horizontally, and values vertically."""
    return axes.get_yaxis_transform()


def _legend(axes: Any, own: Sweep, colored: str, marked: str, low: float) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=color, marker="o", linestyle="", label=f"{colored}={value}")
        for value, color in zip(_values(own, colored), COLORS, strict=False)
    ]
    handles += [
        Line2D([], [], color="0.3", marker=marker, linestyle="", label=f"{marked}={value}")
        for value, marker in zip(_values(own, marked), MARKERS, strict=False)
    ]
    handles.append(Line2D([], [], color="0.3", label="the front"))
    axes.legend(handles=handles, fontsize="small", loc="lower left", bbox_to_anchor=(0.0, low))


def _list(axes: Any, own: Sweep) -> None:
    """The front by numbers, and what failed."""
    axes.axis("off")
    lines = [_line(number, candidate) for number, candidate in enumerate(own.front, start=1)]
    if own.failed:
        reasons = failure_lines(own.failed)
        lines += ["", f"{len(own.failed)} of {len(own.points)} settings failed:"]
        lines += ["    " + textwrap.shorten(line, 116, placeholder=" ...") for line in reasons[:MOST_LISTED]]
        if len(reasons) > MOST_LISTED:
            lines.append(f"    and {len(reasons) - MOST_LISTED} more reasons")
    axes.text(0.0, 1.0, "\n".join(lines), va="top", family="monospace", fontsize=8, transform=axes.transAxes)


def _line(number: int, candidate: Candidate) -> str:
    error = percent(candidate.error) if candidate.resolved else f"< {percent(candidate.bound)}"
    return f"{number:>2}  {candidate.seconds:>8.3g} s  {error:>9}  {candidate.point.setting.label}"
