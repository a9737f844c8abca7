"""``warpfem trade``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warpfem.commands.options import parameters_of, positive, relative_error, study_options
from warpfem.commands.session import FAILED, OK, fail, start_warp
from warpfem.commands.study import opened_study
from warpfem.errors import MissingExtraError, SimulationError
from warpfem.files import remove

if TYPE_CHECKING:
    from warpfem.trade.sweep import Sweep


def add(commands: Any) -> None:
    """Adds the command to the parser."""
    trade = commands.add_parser(
        "trade", help="measure what accuracy costs in a scene, setting by setting", description=execute.__doc__
    )
    study_options(trade)
    trade.add_argument(
        "--axis",
        action="append",
        default=[],
        dest="axes",
        metavar="NAME=VALUE,...",
        help="what to vary, may be repeated: a parameter of the scene, or dt, solver, element, material, dtype, refine "
        "(how often all cells are divided), or a setting of the solver such as tolerance; a value may bring others, "
        "which win over their axes: solver=sdirk2,velocity_verlet:dt=auto; without any axis, the mesh, the element, "
        "the scheme and dt",
    )
    trade.add_argument(
        "--error",
        type=relative_error,
        action="append",
        dest="errors",
        metavar="E",
        help="relative error to find the cheapest setting for, as 1%% or 0.01; may be repeated (default: 10%%, 1%% and "
        "0.1%%)",
    )
    trade.add_argument(
        "--repeats", type=positive, default=3, metavar="N", help="processes that time each setting (default: 3)"
    )
    where = trade.add_mutually_exclusive_group()
    where.add_argument(
        "--workers",
        type=positive,
        default=1,
        metavar="N",
        help="settings that run at the same time on this machine: their times are marked, and not mixed with others",
    )
    where.add_argument("--scheduler", metavar="ADDRESS", help="scheduler of a Dask cluster to run the settings on")
    trade.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of the results, and of the runs that a study goes on from (default: output/SCENE.trade)",
    )
    trade.add_argument("--json", action="store_true", help="print the results as JSON, and nothing else")
    trade.set_defaults(command=execute)


def execute(arguments: argparse.Namespace) -> int:
    """Measures what accuracy costs in a scene: runs all combinations of the axes' values, each in a process of its own
    and several times, and compares them with a reference that is finer in space and time.

    Writes trade.csv, trade.json and, with the extra 'plot', trade.png and trade.svg. A study that was interrupted or
    killed goes on from the runs that it has when the command is given again. Exits with 1 if there is no reference,
    or none that is good enough for an error that was asked for.
    """
    from warpfem.trade import report
    from warpfem.trade.plot import plot, plots

    say = (lambda text: None) if arguments.json else (lambda text: print(text, file=sys.stderr, flush=True))
    out = arguments.out or Path("output") / f"{arguments.scene.stem}.trade"
    start_warp()
    try:
        done = _sweep(arguments, out, say)
    except KeyboardInterrupt:
        return fail(SimulationError(f"interrupted: what has been run is in {out}, and the command goes on"), FAILED)
    for path in plots(out):
        remove(path)  # they would be another study's, if there is none of this one
    written = report.write(done, out)
    if done.reference is not None:
        try:
            written += plot(done, out)
        except MissingExtraError as error:
            say(str(error))
    if arguments.json:
        print(json.dumps(report.data(done), indent=2, allow_nan=False))
    else:
        print(report.text(done))
        print(f"wrote {', '.join(map(str, written))}")
    refused = arguments.errors is not None and any(answer.refusal for answer in done.answers)
    return FAILED if done.reference is None or refused else OK


def _sweep(arguments: argparse.Namespace, out: Path, say: Callable[[str], None]) -> Sweep:
    """Runs the study; what can be wrong with the command is said before anything is run."""
    from warpfem.trade.axes import default_axes, mesh_control, parse_axes, settings_of
    from warpfem.trade.problem import Problem
    from warpfem.trade.sweep import TARGETS, require_quantity, sweep

    problem = Problem.of(arguments.scene, parameters_of(arguments), frames=arguments.frames, device=arguments.device)
    axes = parse_axes(arguments.axes, problem)
    mesh = mesh_control(problem)
    axes = axes or default_axes(problem, mesh)
    require_quantity(problem, arguments.quantity)
    say(f"{arguments.scene}: {len(settings_of(axes, problem))} settings of {', '.join(axis.name for axis in axes)}")
    with opened_study(arguments, problem, out, say) as study:
        targets = arguments.errors or TARGETS
        return sweep(study, axes, mesh, name=arguments.quantity, targets=targets, repeats=arguments.repeats)
