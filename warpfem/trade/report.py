"""A study as text, CSV and JSON."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from warpfem.errors import OutputError
from warpfem.files import replacing
from warpfem.trade.extrapolation import order_text
from warpfem.trade.front import Answer, Candidate, label, percent
from warpfem.trade.machine import facts
from warpfem.trade.reference import Reference
from warpfem.trade.study import Point
from warpfem.trade.sweep import Sweep

PLAIN = (
    "setup_seconds",
    "cells",
    "points",
    "mesh_size",
    "steps",
    "shortest_dt",
    "longest_dt",
    "newton_iterations",
    "cg_iterations",
    "rounded_steps",
    "linear_solver",
)
"""What of the first outcome of a setting is told as it is."""


# ---- text


def text(own: Sweep) -> str:
    """The study for people: the front, what failed, the reference and the answers."""
    lines = [f"{len(own.points)} settings, {len(own.failed)} of them without result; times are wall time of the steps"]
    if own.study.load == "parallel":
        lines[0] += ", taken while other settings ran: they are longer than those of a run alone"
    lines += [f"failed: {line}" for line in failure_lines(own.failed)]
    if own.reference is None:
        return "\n".join([*lines, f"No reference: {own.refusal}"])
    lines += ["", *reference_lines(own.reference, own.name), "", *front_lines(own), ""]
    return "\n".join([*lines, *(answer.sentence for answer in own.answers)])


def failure_lines(failed: Sequence[Point]) -> list[str]:
    """Why settings failed, those that failed for the same reason together."""
    by_reason: dict[str, list[Point]] = {}
    for point in failed:
        by_reason.setdefault(point.failure, []).append(point)
    return [f"{_shared_label(points)}: {reason}" for reason, points in by_reason.items()]


def _shared_label(points: Sequence[Point]) -> str:
    """What settings have in common, and how many they are."""
    if len(points) == 1:
        return points[0].setting.label
    shared = set.intersection(*(set(point.setting) for point in points))
    label = " ".join(f"{name}={value}" for name, value in points[0].setting if (name, value) in shared)
    return f"{len(points)} settings{f' with {label}' if label else ''}"


def reference_lines(reference: Reference, name: str) -> list[str]:
    """The reference, its observed orders and its band."""
    lines = [f"reference, for {label(name)}: off by {percent(reference.band(name))} at most, by its own estimate"]
    for kind, part in reference.parts[name].items():
        rungs = reference.ladders.get(kind, [])
        order = f"observed order {order_text(part.order)}" if part.order is not None else part.remark
        levels = f"{len(rungs)} levels" if rungs else "a tolerance 100 times as large"
        lines.append(f"  {kind}: ± {percent(part.band)}, {levels}" + (f", {order}" if order else ""))
    lines += [f"  {remark}" for remark in dict.fromkeys(reference.remarks)]
    return lines


def front_lines(own: Sweep) -> list[str]:
    """The front as a table."""
    kinds = ("space", "time", "algebra", "model")
    shown = [kind for kind in kinds if any(kind in part for part in own.parts)]
    head = ["seconds", "range", "error", *shown, "setting"]
    rows = [head]
    for candidate, part in zip(own.front, own.parts, strict=True):
        least, most = candidate.point.spread
        error = percent(candidate.error) if candidate.resolved else f"< {percent(candidate.bound)}"
        parts = [percent(part[kind][own.name]) if own.name in part.get(kind, {}) else "-" for kind in shown]
        spread = f"{least:.3g}-{most:.3g}"
        rows.append([f"{candidate.seconds:.3g}", spread, error, *parts, candidate.point.setting.label])
    widths = [max(len(row[k]) for row in rows) for k in range(len(head) - 1)]
    lines = ["  ".join([*(f"{cell:>{w}}" for cell, w in zip(row, widths, strict=False)), row[-1]]) for row in rows]
    return [f"the front: no other setting is both faster and more accurate in {label(own.name)}", *lines]


# ---- data


def data(own: Sweep) -> dict[str, Any]:
    """The whole study, as JSON has it."""
    problem = own.study.problem
    by_setting = {candidate.point.setting: candidate for candidate in own.ordered}
    on_front = {c.point.setting: part for c, part in zip(own.front, own.parts, strict=True)}
    return _finite(
        {
            "scene": problem.path,
            "parameters": dict(problem.parameters),
            "frames": own.study.scene.frames,
            "axes": {axis.name: list(axis.values) for axis in own.axes},
            "quantity": own.name,
            "load": own.study.load,
            "machine": facts(),
            "ran_on": _machines(own.points),
            "reference": None if own.reference is None else _reference_data(own.reference),
            "refusal": own.refusal,
            "settings": [
                _point_data(point, own.reference, by_setting.get(point.setting), on_front.get(point.setting))
                for point in own.points
            ],
            "answers": [_answer_data(answer) for answer in own.answers],
        }
    )


def _machines(points: Sequence[Point]) -> list[dict[str, Any]]:
    """The machines that settings ran on, which can be others than that of the command, each once."""
    found: list[dict[str, Any]] = []
    for outcome in (outcome for point in points for outcome in point.outcomes):
        machine = {name: value for name, value in outcome.machine.items() if name != "load_average"}
        if machine not in found:
            found.append(machine)
    return found


def _reference_data(reference: Reference) -> dict[str, Any]:
    return {
        "names": {
            name: {
                "scale": reference.scales[name],
                "value": reference.outcome.quantities.get(name),
                "band": reference.band(name),
                "parts": {kind: asdict(part) for kind, part in reference.parts[name].items()},
            }
            for name in reference.names
        },
        "ladders": {
            kind: [
                {"setting": dict(rung.setting), "mesh_size": rung.size, "dt": rung.outcome.longest_dt}
                | {"quantities": rung.outcome.quantities, "seconds": rung.outcome.seconds}
                for rung in rungs
            ]
            for kind, rungs in reference.ladders.items()
        },
        "remarks": list(dict.fromkeys(reference.remarks)),
    }


def _point_data(
    point: Point, reference: Reference | None, candidate: Candidate | None, parts: Mapping[str, Any] | None
) -> dict[str, Any]:
    first = point.first
    record: dict[str, Any] = {"setting": dict(point.setting), "failure": point.failure, "on_front": parts is not None}
    if point.failure:
        return record
    least, most = point.spread
    compiled = point.kernel_seconds
    record |= {
        "seconds": point.seconds,
        "seconds_least": least,
        "seconds_most": most,
        "processes": len(point.samples),
        "kernel_seconds_least": compiled[0],
        "kernel_seconds_most": compiled[1],
        "peak_bytes": point.peak_bytes,
        **{name: getattr(first, name) for name in PLAIN},
        "quantities": first.quantities,
        "missing": first.missing,
        "load_averages": [outcome.machine.get("load_average") for outcome in point.outcomes],
    }
    if reference is not None:
        record["errors"] = reference.errors(first)
    if candidate is not None:
        record["resolved"] = candidate.resolved
    if parts is not None:
        record["parts"] = parts
    return record


def _answer_data(own: Answer) -> dict[str, Any]:
    setting = None if own.candidate is None else dict(own.candidate.point.setting)
    return {
        "error": own.target,
        "setting": setting,
        "refusal": own.refusal,
        "next_seconds": own.next_seconds,
        "next_how": own.next_how,
        "next_unknown": own.next_unknown,
        "sentence": own.sentence,
    }


def _finite(value: Any) -> Any:
    """JSON knows neither infinity nor NaN."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value


def rows(own: Sweep) -> list[dict[str, Any]]:
    """A row of plain values for each setting, as CSV has it.

    An axis can be called as a measured number is, such as ``cells``: its column is ``axis_cells``.
    """
    table = []
    names = dict.fromkeys(
        [*(axis.name for axis in own.axes), *(name for point in own.points for name in dict(point.setting))]
    )
    for record in data(own)["settings"]:
        row = {f"axis_{name}": record["setting"].get(name, "") for name in names}
        row |= {"failure": record["failure"], "load": own.study.load, "on_front": record["on_front"]}
        for name, value in record.items():
            if name in ("errors", "quantities"):
                row |= {f"{name.rstrip('s') if name == 'errors' else 'value'}_{key}": own for key, own in value.items()}
            elif name == "parts":
                row |= {f"error_in_{kind}": errors.get(own.name) for kind, errors in value.items()}
            elif not isinstance(value, dict | list):
                row[name] = value
        table.append(row)
    return table


def write(own: Sweep, folder: Path) -> list[Path]:
    """Writes ``trade.json`` and ``trade.csv``.

    Raises:
        OutputError: they cannot be written.
    """
    table = rows(own)
    names = list(dict.fromkeys(name for row in table for name in row))
    paths = [folder / "trade.json", folder / "trade.csv"]
    try:
        with replacing(paths[0]) as temporary:
            temporary.write_text(json.dumps(data(own), indent=2, allow_nan=False) + "\n", encoding="utf-8")
        with replacing(paths[1]) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(table)
    except OSError as error:
        raise OutputError(f"cannot write to {folder}: {error.strerror or error}") from None
    return paths
