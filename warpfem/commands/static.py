"""``warpfem static``."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

from warpfem.commands.options import load, scene_options
from warpfem.commands.output import kept, require_consent
from warpfem.commands.session import FAILED, OK, fail, held_interrupt, start_warp
from warpfem.errors import SimulationError
from warpfem.solvers import StaticEquilibrium


def add(commands: Any) -> None:
    """Adds the command to the parser."""
    static = commands.add_parser(
        "static", help="solve a scene's static equilibrium and store it", description=execute.__doc__
    )
    scene_options(static, dtype="float64")
    static.set_defaults(frames=None, fps=None)
    static.add_argument(
        "--out", type=Path, metavar="F", help="output .usdc, .usd or .usda (default: output/SCENE.static.usdc)"
    )
    static.add_argument(
        "--time", type=float, metavar="T", help="when prescribed motions are held [s] (default: at the last frame)"
    )
    static.add_argument(
        "--tolerance",
        type=float,
        default=StaticEquilibrium.tolerance,
        metavar="R",
        help="largest unbalanced force relative to the largest force that acts (default: %(default)s)",
    )
    static.add_argument(
        "--load-steps",
        type=int,
        default=StaticEquilibrium.load_steps,
        metavar="N",
        help="increments of loads and motions, at least (default: 1, and more only where it needs them)",
    )
    static.add_argument("--overwrite", action="store_true", help="replace an output that exists, without asking")
    static.add_argument("--quiet", action="store_true", help="print nothing but errors")
    static.add_argument("--json", action="store_true", help="print the summary as JSON, and nothing else")
    static.set_defaults(command=execute)


def execute(arguments: argparse.Namespace) -> int:
    """Solves the static equilibrium of a scene under its loads, and stores it in a USD file.

    Bodies start from their initial displacement; velocities and damping do not matter. Frame 0 of the file is the
    start, and one frame each shows the equilibria on the way to the full load, the last one under it.
    """
    from warpfem.static_run import StaticRun, record_static, summary_text

    start_warp()
    solver = StaticEquilibrium(arguments.tolerance, load_steps=arguments.load_steps)
    arguments.dtype = arguments.dtype or arguments.default_dtype  # that of settings is meant for time steps
    scene = load(arguments)
    out = arguments.out or Path("output") / f"{arguments.scene.stem}.static.usdc"
    with held_interrupt() as check_interrupt:
        from warpfem.usd import check_path
    check_interrupt()
    check_path(out)
    if not arguments.overwrite:
        require_consent(out)
    say = not (arguments.quiet or arguments.json)
    if say:
        print(f"{arguments.scene}: solving (the first time its kernels are compiled)", file=sys.stderr)
    run = StaticRun(scene, solver, time=arguments.time, device=arguments.device, dtype=arguments.dtype)
    summary = run.summary
    code = OK
    try:
        with held_interrupt() as check_interrupt, closing(record_static(run, out)) as frames:
            for frame in frames:
                if say and frame.index > 0:
                    print(f"equilibrium under {100.0 * summary.fractions[-1]:.4g} % of the load", file=sys.stderr)
                check_interrupt()
    except KeyboardInterrupt:
        if not summary.fractions:
            raise
        code = fail(SimulationError(f"interrupted: {kept(out)}"), FAILED)
    except SimulationError as error:
        if not summary.fractions:
            raise
        error.add_note(kept(out))
        code = fail(error, FAILED)
    if arguments.json:
        data = {"scene": str(arguments.scene), "file": str(out), "dtype": arguments.dtype, **asdict(summary)}
        print(json.dumps(data, indent=2))
    elif not arguments.quiet and code == OK:
        print(summary_text(summary))
        print(f"wrote {out}")
    return code
