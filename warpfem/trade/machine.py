"""Facts of the machine, without which a time says nothing."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import sys
from pathlib import Path
from typing import Any

from warpfem import __version__
from warpfem.threads import available_threads


def facts() -> dict[str, Any]:
    """The processor, what it may use, the load at this moment, and versions."""
    processor = _read("/proc/cpuinfo")
    model = re.search(r"model name\s*:\s*(.*)", processor)
    memory = re.search(r"MemTotal:\s*(\d+)", _read("/proc/meminfo"))
    return {
        "processor": model.group(1) if model else platform.processor(),
        "cores": available_threads(),
        "memory_gib": round(int(memory.group(1)) / 2**20, 1) if memory else None,
        "load_average": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "warpfem": __version__,
        "warp": importlib.metadata.version("warp-lang"),
        "numpy": importlib.metadata.version("numpy"),
    }


def peak_bytes() -> int:
    """The largest memory that this process has held so far."""
    peak = re.search(r"VmHWM:\s*(\d+) kB", _read("/proc/self/status"))
    if peak:
        return 1024 * int(peak.group(1))
    try:
        import resource
    except ImportError:
        return 0
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest if sys.platform == "darwin" else 1024 * largest


def _read(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""
