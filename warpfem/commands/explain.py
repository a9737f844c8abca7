"""``warpfem explain``."""

from __future__ import annotations

import argparse
from typing import Any

from warpfem.commands.options import load, scene_options, time_options
from warpfem.commands.session import OK, start_warp


def add(commands: Any) -> None:
    """Adds the command to the parser."""
    explain = commands.add_parser(
        "explain",
        help="say what a scene requires, and so what is modelled (steps it for some seconds)",
        description=execute.__doc__,
    )
    scene_options(explain)
    time_options(explain)
    explain.set_defaults(command=execute)


def execute(arguments: argparse.Namespace) -> int:
    """Says what a scene requires, and so what is modelled, compiled, stored and paid for in a step."""
    from warpfem.explain import explain

    start_warp()
    print(explain(load(arguments), device=arguments.device, dtype=arguments.dtype))
    return OK
