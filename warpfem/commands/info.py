"""``warpfem info``."""

from __future__ import annotations

import argparse
import importlib.metadata
import platform
from typing import Any

import warpfem
from warpfem.commands.session import OK, start_warp

EXTRAS = {
    "meshio": "mesh",
    "trimesh": "mesh",
    "pytetwild": "tet",
    "matplotlib": "plot",
    "pillow": "plot",
    "imageio-ffmpeg": "video",
    "tqdm": "progress",
    "scipy": "bench",
    "scikit-fem": "bench",
    "distributed": "cluster",
    "newton": "newton",
}
"""Optional packages and the extra that brings them."""


def add(commands: Any) -> None:
    """Adds the command to the parser."""
    info = commands.add_parser("info", help="print versions and devices", description=execute.__doc__)
    info.set_defaults(command=execute)


def execute(arguments: argparse.Namespace) -> int:
    """Prints versions and devices."""
    import warp

    start_warp()
    print(f"warpfem {warpfem.__version__}, Python {platform.python_version()}, {platform.platform()}")
    for package in ("warp-lang", "numpy", "usd-core"):
        print(f"{package} {importlib.metadata.version(package)}")
    for package, extra in EXTRAS.items():
        try:
            print(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            print(f"{package} not installed: pip install 'warpfem[{extra}]'")
    print("devices: " + ", ".join(f"{device.alias} ({device.name})" for device in warp.get_devices()))
    return OK
