"""``warpfem extremes``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from warpfem.commands.output import make_writable
from warpfem.commands.session import FAILED, OK, start_warp
from warpfem.errors import WarpfemError

STABILITY_PAGE = Path("docs") / "stability.md"


def add(commands: Any) -> None:
    """Adds the command to the parser."""
    extremes = commands.add_parser(
        "extremes", help="measure the stability of warpfem at the extremes", description=execute.__doc__
    )
    extremes.add_argument("--quick", action="store_true", help="few settings and small meshes, about two minutes")
    extremes.add_argument("--json", action="store_true", help="print the results as JSON, and nothing else")
    extremes.add_argument(
        "--case", type=int, nargs="+", default=[], metavar="N", help="only the cases of these numbers"
    )
    extremes.add_argument(
        "--out",
        type=Path,
        metavar="F",
        help=f"Markdown file of all figures (default: {STABILITY_PAGE}, if neither --quick nor --case is given)",
    )
    extremes.set_defaults(command=execute)


def execute(arguments: argparse.Namespace) -> int:
    """Runs the cases of the stability table: extreme deformations, parameters, scales, steps and wrong input.

    Every trial passes, is refused with a clear message, or FAILs; any FAIL makes the exit code 1.
    """
    from warpfem.extremes import CASES, report

    unknown = sorted(set(arguments.case) - set(CASES))
    if unknown:
        raise WarpfemError(f"there is no case {unknown[0]}: the cases are {', '.join(map(str, sorted(CASES)))}")
    out = arguments.out or (None if arguments.quick or arguments.case else STABILITY_PAGE)
    if out:
        make_writable(out)
    start_warp()
    say = not arguments.json
    if say:
        print(report.text_header(), flush=True)
    outcomes = []
    for outcome in report.run_cases(sorted(set(arguments.case) or CASES), arguments.quick, start_warp):
        outcomes.append(outcome)
        if say:
            print(report.text_row(outcome), flush=True)
    if arguments.json:
        print(json.dumps(report.json_data(outcomes, arguments.quick), indent=2, allow_nan=False))
    if out:
        out.write_text(report.markdown(outcomes, arguments.quick), encoding="utf-8")
        if say:
            print(f"wrote {out}")
    return FAILED if report.failed(outcomes) else OK
