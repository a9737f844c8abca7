"""Whether ``warpfem tune`` finds what a sweep would: true errors of its settings, and their cost beside the best's.

    python benchmarks/tuning.py                      # all cases, and docs/tuning.md: an hour or two
    python benchmarks/tuning.py --case cantilever:10%

Each case is a shipped scene and an error. Errors are measured against a much finer run; the page tells where that is
also among those of tuning's reference. The sweep has all combinations of meshes, cells, schemes and steps of its table,
and its best is the fastest of those whose error is within the target by that same run. Both are timed in turn. Runs are
kept in ``--folder``: what was interrupted goes on. The results are kept beside the page, which has those of the cases
that were not asked for, too.
"""

from __future__ import annotations

import argparse
import json
import math
import textwrap
import time
from dataclasses import dataclass
from pathlib import Path

from warpfem.errors import SimulationError
from warpfem.trade.axes import mesh_control
from warpfem.trade.executors import local_executor
from warpfem.trade.front import rounded
from warpfem.trade.machine import facts
from warpfem.trade.problem import FORCED, Problem, Setting
from warpfem.trade.reference import relative
from warpfem.trade.store import Store
from warpfem.trade.study import Point, Study, difference
from warpfem.trade.tune import tune

SCENES = Path(__file__).parent.parent / "scenes"

STEPS = (1, 4)
"""Steps of a frame in sweeps."""

CHEAP = 2.0
"""Times the cost of the best of the sweep up to which a setting is cheap."""

SCHEMES = ("linearised", "backward_euler", "sdirk2")


@dataclass(frozen=True)
class Case:
    """A scene, the errors asked for, the meshes of its sweep and the mesh of the run that is taken for true.

    Attributes:
        scene: its name.
        errors: relative, of the motion.
        cells: values of its parameter ``cells`` in the sweep.
        true_cells: that of the true motion, of quadratic cells.
        parameters: other values of the scene's parameters, as text.
        limit: wall time of a run [s].
    """

    scene: str
    errors: tuple[float, ...]
    cells: tuple[int, ...]
    true_cells: int
    parameters: tuple[tuple[str, str], ...] = ()
    limit: float = 100.0

    @property
    def problem(self) -> Problem:
        """The scene with its parameters."""
        return Problem.of(SCENES / f"{self.scene}.py", dict(self.parameters))


CASES = (  # the true meshes are not among those of a reference, whose numbers of cells go 1, 2, 4, 6, 8, 12, 16
    Case("cantilever", (0.1, 0.01), (1, 2, 4, 8), 10),
    Case("twist", (0.1, 0.01), (1, 2, 4, 8), 10),
    # the stiffness of the floor goes with the cells by default
    Case("jelly_drop", (0.1, 0.01), (2, 3, 6, 12), 20, (("stiffness", "4e5"),), limit=200.0),
    Case("stretch", (0.1, 0.01), (1, 2, 4, 8), 10, limit=200.0),
    Case("two_materials", (0.1, 0.01), (1, 2, 4, 8), 10),
    Case("custom_material", (0.1, 0.01), (1, 2, 4, 8), 14),
)


def sweep_settings(case: Case) -> list[Setting]:
    """All settings of a case's sweep."""
    times = [{f"{FORCED}solver": "velocity_verlet", f"{FORCED}dt": "auto"}]
    times += [
        {f"{FORCED}solver": scheme, f"{FORCED}dt": f"1/{steps * fps_of(case)}"} for scheme in SCHEMES for steps in STEPS
    ]
    return [
        Setting.of(cells=cells, **{f"{FORCED}element": element}, **own)
        for cells in case.cells
        for element in ("linear", "quadratic")
        for own in times
    ]


def fps_of(case: Case) -> int:
    return round(case.problem.build(Setting()).scene.fps)


def true_setting(case: Case) -> Setting:
    """The finest run: explicit steps in float64, of quadratic cells."""
    own = {"element": "quadratic", "solver": "velocity_verlet", "dt": "auto"}
    return Setting.of(cells=case.true_cells, dtype="float64", **{f"{FORCED}{name}": v for name, v in own.items()})


def measure(case: Case, target: float, folder: Path, repeats: int) -> dict:
    """Tunes, sweeps and compares.

    Args:
        case: the scene.
        target: the relative error.
        folder: of runs.
        repeats: processes that time what was found, and the best of the sweep.
    """

    def say(text: str) -> None:
        print(f"  {text}", flush=True)

    problem = case.problem
    with local_executor(1) as pool:
        study = Study(problem, Store(folder / case.scene), pool, limit=case.limit, say=say)
        start = time.perf_counter()
        scene = " ".join([case.scene, *(f"{name}={value}" for name, value in case.parameters)])
        record: dict = {"scene": scene, "error": target, "machine": facts()}
        try:
            found = tune(study, mesh_control(problem), "l2", target, repeats=repeats)
        except SimulationError as error:
            return record | {"refusal": str(error)}
        record |= {"tuning_seconds": time.perf_counter() - start, "tried": found.tried}
        patient = Study(problem, study.store, pool, limit=10.0 * case.limit, say=say)
        (true,) = patient.solve([true_setting(case)])
        if true.failure:
            return record | {"refusal": f"no true motion: {true.failure}"}

        def error_of(point: Point) -> float:
            if point.failure:
                return math.inf
            return relative(difference(point.first, true.first), found.reference.scales)["l2"]

        quick = 2.0 * found.point.seconds + 6.0  # what takes longer cannot be the best
        points = Study(problem, study.store, pool, limit=quick, say=say).run(sweep_settings(case))
        within = sorted((p for p in points if error_of(p) <= target), key=lambda p: p.seconds)
        near = [p.setting for p in within if p.seconds <= 1.5 * within[0].seconds][:4]
        own, *others = study.run([found.setting, *near], repeats)
        best = min(others, key=lambda p: p.seconds, default=None)
        record |= {
            "setting": found.setting.label,
            "seconds": own.seconds,
            "estimated_error": found.error,
            "true_error": error_of(own),
            "true_in_reference": true.setting.canonical
            in {rung.setting.canonical for rungs in found.reference.ladders.values() for rung in rungs},
            "band": found.band,
            "sweep": len(points),
            "best": best and best.setting.label,
            "best_seconds": best and best.seconds,
            "best_error": best and error_of(best),
            "ratio": best and own.seconds / best.seconds,
        }
    return record


def row(record: dict) -> str:
    """A line for people."""
    head = f"{record['scene']} {100 * record['error']:g} %: "
    if "refusal" in record:
        return head + f"refused: {record['refusal']}"
    best = "the sweep has none within it"
    if record["best"]:
        best = f"{record['ratio']:.2f} times {record['best']} ({record['best_seconds']:.3g} s)"
    return (
        f"{head}{record['setting']}: true error {100 * record['true_error']:.2g} %, {record['seconds']:.3g} s, {best}; "
        f"tried {record['tried']}, sweep {record['sweep']}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", action="append", default=[], metavar="SCENE[:E]", help="only these")
    parser.add_argument("--out", type=Path, default=Path("docs/tuning.md"), help="the page (default: %(default)s)")
    parser.add_argument("--folder", type=Path, default=Path("output/tuning"), help="of runs (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=3, help="processes that time each (default: %(default)s)")
    arguments = parser.parse_args()
    kept = arguments.out.with_suffix(".json")
    records = json.loads(kept.read_text()) if kept.exists() else {}
    for case, target in all_cases():
        name = name_of(case, target)
        if arguments.case and not {case.scene, name} & set(arguments.case):
            continue
        records[name] = measure(case, target, arguments.folder, arguments.repeats)
        print(row(records[name]), flush=True)
        kept.write_text(json.dumps(records, indent=2) + "\n")
        arguments.out.write_text(page(records))


def page(records: dict[str, dict]) -> str:
    """The page of the results of cases, by their names."""
    names = [name_of(case, target) for case, target in all_cases()]
    measured = [records[name] for name in names if name in records]
    found = [record for record in measured if "refusal" not in record]
    within = sum(record["true_error"] <= record["error"] for record in found)
    cheap = sum(record["ratio"] is None or record["ratio"] <= CHEAP for record in found)
    refused = [record for record in measured if "refusal" in record]
    machines = dict.fromkeys(_machine(record["machine"]) for record in measured)
    loads = [record["machine"]["load_average"] for record in measured if record["machine"]["load_average"] is not None]
    load = f", with a load average of {min(loads):.1f} to {max(loads):.1f}" if loads else ""
    summary = (
        f"{within} of {len(found)} settings are within the error asked for, and {cheap} take no more than {CHEAP:g} "
        "times as long as the best of the sweep."
    )
    lines = [
        "# What tuning finds",
        "",
        *_prose(
            "Written by `python benchmarks/tuning.py`: `warpfem tune` finds settings of shipped scenes for an error of "
            "the motion (L2). The true error is that against a much finer run: explicit steps in float64, of quadratic "
            "cells; a star where that run is in tuning's reference, too. Beside it is the best of a sweep of all "
            "combinations of four meshes, two kinds of cells, and seven schemes and steps: the fastest whose true "
            "error is within what is asked for. Both are timed in turn, and times are the median of some processes, of "
            "the steps alone. Runs of the sweep that take longer than twice as long and 6 s more are ended: where "
            "none is left that is within the error, what was found is cheaper than all."
        ),
        f"**{summary}**",
        "",
        "| scene | asked | setting found | estimated error | true | time | best of the sweep | time | ratio | tried |",
        "| --- " * 10 + "|",
        *map(_table_row, found),
        "",
    ]
    for record in refused:
        lines += _prose(f"{record['scene']}, {_percent(record['error'])}: refused. {_sentence(record['refusal'])}")
    lines += _prose(
        "'Tried' counts the settings that tuning has run, those of its reference not included; the sweep has "
        f"{max((record['sweep'] for record in found), default=0)}. Measured on {'; '.join(machines)}{load}."
    )
    return "\n".join(lines).rstrip() + "\n"


def all_cases() -> list[tuple[Case, float]]:
    """All cases, each with one of its errors."""
    return [(case, target) for case in CASES for target in case.errors]


def name_of(case: Case, target: float) -> str:
    """As one names it on the command line."""
    return f"{case.scene}:{100 * target:g}%"


def _table_row(record: dict) -> str:
    cells = [record["scene"], _percent(record["error"]), _short(record["setting"])]
    star = "*" if record["true_in_reference"] else ""
    cells += [_percent(record["estimated_error"]), _percent(record["true_error"]) + star]
    cells.append(f"{rounded(record['seconds'])} s")
    if record["best"]:
        cells += [_short(record["best"]), f"{rounded(record['best_seconds'])} s", f"{record['ratio']:.2f}"]
    else:
        cells += ["none is within it", "", ""]
    return f"| {' | '.join([*cells, str(record['tried'])])} |"


def _short(label: str) -> str:
    return label.replace(FORCED, "")


def _machine(own: dict) -> str:
    cores = "one core" if own["cores"] == 1 else f"{own['cores']} cores"
    return f"{own['processor']}, {cores}, warpfem {own['warpfem']}, warp {own['warp']}"


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _percent(part: float) -> str:
    return f"{100 * part:.2g} %"


def _prose(text: str) -> list[str]:
    return [*textwrap.wrap(text, 118, break_long_words=False, break_on_hyphens=False), ""]


if __name__ == "__main__":
    main()
