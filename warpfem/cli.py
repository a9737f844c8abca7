"""The command ``warpfem``."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence

import warpfem
from warpfem.commands import explain, extremes, info, plot, preview, run, static, trade, tune
from warpfem.commands.session import FAILED, WRONG_USE, fail
from warpfem.errors import SimulationError, TimeStepError, WarpfemError

COMMANDS = (run, static, explain, trade, tune, preview, plot, extremes, info)
"""In the order of the help text."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns 0, 1 for a failed run or 2 for wrong use."""
    arguments = parser().parse_args(argv)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning  # type: ignore[assignment]
            return arguments.command(arguments)
    except TimeStepError as error:
        return fail(error, WRONG_USE)
    except SimulationError as error:
        return fail(error, FAILED)
    except WarpfemError as error:
        return fail(error, WRONG_USE)
    except KeyboardInterrupt:
        return fail(SimulationError("interrupted before anything was written"), FAILED)


def _show_warning(message: Warning | str, *_: object) -> None:
    print(f"warpfem: warning: {message}", file=sys.stderr)


def parser() -> argparse.ArgumentParser:
    """The parser of the command line, with all commands."""
    parser = argparse.ArgumentParser(
        prog="warpfem", description="Simulates elastic solids by finite elements and stores the animation in USD."
    )
    parser.add_argument("--version", action="version", version=f"warpfem {warpfem.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
