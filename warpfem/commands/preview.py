"""``warpfem preview``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from warpfem.commands.session import OK


def add(commands: Any) -> None:
    """Adds the command to the parser."""
    preview = commands.add_parser("preview", help="draw a run to PNG, GIF or MP4", description=execute.__doc__)
    preview.add_argument(
        "file",
        type=Path,
        metavar="FILE",
        help="a USD file that warpfem wrote, partial ones included, or any with meshes that move",
    )
    preview.add_argument(
        "-o",
        "--out",
        type=Path,
        required=True,
        metavar="F",
        help=".png (a sheet of frames), or .gif or .mp4 (the motion)",
    )
    preview.add_argument(
        "--camera",
        metavar="C",
        help="front, right, back, left, top or bottom, or AZIMUTH,ELEVATION in degrees, which are 0,0 at the front and "
        "90,0 at the right (default: 28,20)",
    )
    preview.add_argument(
        "--color",
        metavar="NAME",
        help="what colours show: displacement, speed, or a primvar of the file such as vonMises or J "
        "(default: what the file's own colours show)",
    )
    preview.set_defaults(command=execute)


def execute(arguments: argparse.Namespace) -> int:
    """Draws a run: a sheet of frames as PNG, or the motion as GIF (needs the extra 'plot') or MP4 (and 'video')."""
    from warpfem.preview import preview

    print(f"wrote {preview(arguments.file, arguments.out, camera=arguments.camera, color=arguments.color)}")
    return OK
