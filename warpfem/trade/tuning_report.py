"""What tuning found, as text, as data and as a file of settings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from warpfem.trade.front import label, percent, rounded
from warpfem.trade.machine import facts
from warpfem.trade.problem import FORCED, Setting
from warpfem.trade.reference import Reference
from warpfem.trade.report import reference_lines
from warpfem.trade.settings_file import SettingsFile
from warpfem.trade.study import Study
from warpfem.trade.tune import Tuned


def sentence(own: Tuned) -> str:
    """The answer for people."""
    least, most = own.point.spread
    return (
        f"The cheapest setting found within {percent(own.target)} of {label(own.name)} is {_label(own.setting)}: "
        f"{rounded(own.point.seconds)} s of steps ({rounded(least)} to {rounded(most)} s), off by {percent(own.error)} "
        f"(± {percent(own.band)})"
    )


def text(own: Tuned) -> str:
    """The answer, what it rests on, and what else came near."""
    parts = ", ".join(f"{kind} {percent(value)}" for kind, value in own.parts.items())
    lines = [sentence(own), f"its parts, by one change each: {parts}"]
    if own.seen is not None and own.unseen is not None:
        lines.append(
            f"chosen on the first {own.frames} frames, where it is off by {percent(own.seen)}; over the others, "
            f"which the search has not seen, by {percent(own.unseen)}"
        )
    lines += reference_lines(own.reference, own.name)
    lines.append(f"{own.tried} settings were tried, and these over all frames:")
    lines += [
        f"  {trial.seconds:9.3g} s  {percent(trial.error):>8}  {_label(trial.setting)}"
        for trial in own.contenders
        if math.isfinite(trial.error)
    ]
    return "\n".join(lines)


def data(own: Tuned, study: Study) -> dict[str, Any]:
    """The answer as JSON has it."""
    settings = settings_file(own, study, command="")
    return {
        "scene": study.problem.path,
        "setting": dict(own.setting),
        "sentence": sentence(own),
        "parameters": settings.parameters,
        "changes": settings.changes,
        "estimate": _estimate(own),
        "reference": _reference(own.reference, own.name),
        "contenders": [
            {"setting": dict(t.setting), "seconds": t.seconds, "error": t.error}
            for t in own.contenders
            if math.isfinite(t.error)
        ],
        "tried": own.tried,
        "machine": facts(),
    }


def settings_file(own: Tuned, study: Study, command: str) -> SettingsFile:
    """The file that ``warpfem run --settings`` takes.

    Args:
        own: what was found.
        study: by what.
        command: what was asked, as one would write it.
    """
    known = {name: value for name, value in facts().items() if value is not None and name != "load_average"}
    notes = {
        "estimate": {"command": command, **_estimate(own)} if command else _estimate(own),
        "reference": _reference(own.reference, own.name),
        "machine": known,
    }
    return SettingsFile.of(study.problem, own.setting, notes)


def write(own: Tuned, study: Study, path: Path, command: str) -> None:
    """Writes that file.

    Raises:
        OutputError: it cannot be written.
    """
    remarks = [sentence(own), f"Written by: {command}", f"Use it by: warpfem run SCENE --settings {path.name}"]
    settings_file(own, study, command).write(path, remarks)


def _label(setting: Setting) -> str:
    return " ".join(f"{name.removeprefix(FORCED)}={value}" for name, value in setting)


def _estimate(own: Tuned) -> dict[str, Any]:
    least, most = own.point.spread
    estimate: dict[str, Any] = {"quantity": own.name, "target": own.target, "error": own.error, "band": own.band}
    if own.seen is not None and own.unseen is not None:
        estimate |= {"frames_seen": own.frames, "error_seen": own.seen, "error_unseen": own.unseen}
    estimate |= {f"error_in_{kind}": value for kind, value in own.parts.items()}
    estimate |= {"seconds": own.point.seconds, "seconds_least": least, "seconds_most": most}
    return estimate | {"peak_bytes": own.point.peak_bytes, "steps": own.point.first.steps}


def _reference(reference: Reference, name: str) -> dict[str, Any]:
    found: dict[str, Any] = {"band": reference.band(name)}
    value = reference.outcome.quantities.get(name)
    if value is not None:
        found["value"] = value
    for kind, part in reference.parts[name].items():
        found[f"band_in_{kind}"] = part.band
        if part.order is not None:
            found[f"order_in_{kind}"] = part.order
    for kind, rungs in reference.ladders.items():
        if kind in reference.parts[name]:
            found[f"finest_in_{kind}"] = _label(rungs[-1].setting)
    return found
