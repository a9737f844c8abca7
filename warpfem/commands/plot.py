"""``warpfem plot``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from warpfem.commands.session import OK


def add(commands: Any) -> None:
    """Adds the command to the parser."""
    plot = commands.add_parser(
        "plot", help="draw energies, displacements and stress over time", description=execute.__doc__
    )
    plot.add_argument(
        "run", type=Path, metavar="RUN", help="a log (.csv or .jsonl), or a USD file with its log beside it"
    )
    plot.add_argument("-o", "--out", type=Path, metavar="F", help=".png or .svg (default: LOG.plot.png)")
    plot.add_argument(
        "--curve",
        action="append",
        default=[],
        dest="curves",
        metavar="TEXT",
        help="draw only displacements with this in their names, such as top or uy; may be repeated "
        "(default: those that change most)",
    )
    plot.set_defaults(command=execute)


def execute(arguments: argparse.Namespace) -> int:
    """Draws the log that `warpfem run --log` wrote: energies, displacements of bodies and point sets, the largest
    stress and the least J, over time (needs the extra 'plot').
    """
    from warpfem.plot import plot

    print(f"wrote {plot(arguments.run, arguments.out, curves=arguments.curves)}")
    return OK
