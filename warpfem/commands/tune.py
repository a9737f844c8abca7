"""``warpfem tune``."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

from warpfem.commands.options import parameters_of, positive, relative_error, study_options
from warpfem.commands.session import FAILED, OK, fail, start_warp
from warpfem.commands.study import opened_study
from warpfem.errors import SimulationError


def add(commands: Any) -> None:
    """Adds the command to the parser."""
    tune = commands.add_parser(
        "tune", help="find the cheapest setting of a scene within an error", description=execute.__doc__
    )
    study_options(tune)
    tune.add_argument("--error", type=relative_error, required=True, metavar="E", help="relative error, as 1%% or 0.01")
    tune.add_argument(
        "--workers",
        type=positive,
        default=1,
        metavar="N",
        help="settings that are tried at the same time on this machine; what is found is timed alone",
    )
    tune.add_argument(
        "--out", type=Path, metavar="FILE", help="file of the settings (default: output/SCENE.settings.toml)"
    )
    tune.add_argument("--json", action="store_true", help="print the result as JSON, and nothing else")
    tune.set_defaults(command=execute, scheduler=None)


def execute(arguments: argparse.Namespace) -> int:
    """Finds the cheapest setting of a scene within an error - mesh, cells, time steps, scheme, precision -, and writes
    it to a file that `warpfem run SCENE --settings FILE` takes.

    Settings are tried on the first half of the frames, and what is found is verified on the others, against a reference
    that is finer in space and time; of a quantity, which is a number of the whole motion, on all frames. Without a
    reference that is accurate enough the search is refused, with exit code 1. Runs are kept in output/SCENE.trade,
    where those of `warpfem trade` are, and not repeated.
    """
    from warpfem.trade import tuning_report
    from warpfem.trade.axes import mesh_control
    from warpfem.trade.problem import Problem
    from warpfem.trade.sweep import require_quantity
    from warpfem.trade.tune import tune

    start_warp()
    problem = Problem.of(arguments.scene, parameters_of(arguments), frames=arguments.frames, device=arguments.device)
    require_quantity(problem, arguments.quantity)
    mesh = mesh_control(problem)
    out = arguments.out or Path("output") / f"{arguments.scene.stem}.settings.toml"
    folder = Path("output") / f"{arguments.scene.stem}.trade"
    say = (lambda text: None) if arguments.json else (lambda text: print(text, file=sys.stderr, flush=True))
    try:
        with opened_study(arguments, problem, folder, say) as study:
            found = tune(study, mesh, arguments.quantity, arguments.error)
    except KeyboardInterrupt:
        return fail(SimulationError(f"interrupted: what has been run is in {folder}, and the command goes on"), FAILED)
    tuning_report.write(found, study, out, _tune_command(arguments))
    if arguments.json:
        print(json.dumps(tuning_report.data(found, study), indent=2, allow_nan=False))
    else:
        print(tuning_report.text(found))
        print(f"wrote {out}")
    return OK


def _tune_command(arguments: argparse.Namespace) -> str:
    """The command as one would write it, without what does not bear on its result."""
    words = ["warpfem", "tune", str(arguments.scene), "--error", f"{arguments.error:g}"]
    words += [word for text in arguments.parameters for word in ("--set", text)]
    words += [] if arguments.frames is None else ["--frames", str(arguments.frames)]
    words += [] if arguments.quantity == "l2" else ["--quantity", arguments.quantity]
    return shlex.join(words)
