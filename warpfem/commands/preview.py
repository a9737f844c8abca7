"""``warpfem preview``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from warpfem.commands.session import OK


def add(commands: Any) -> None:
    """Adds the command to the parser."""
    preview = commands.add_parser("preview", help="draw a run to PNG or GIF", description=execute.__doc__)
    preview.add_argument("file", type=Path, metavar="FILE", help="a USD file that warpfem wrote")
    preview.add_argument(
        "-o", "--out", type=Path, required=True, metavar="F", help=".png (a sheet of frames) or .gif (the motion)"
    )
    preview.set_defaults(command=execute)


def execute(arguments: argparse.Namespace) -> int:
    """Draws a run: a sheet of frames as PNG, or the motion as GIF (needs the extra 'plot')."""
    from warpfem.preview import preview

    print(f"wrote {preview(arguments.file, arguments.out)}")
    return OK
