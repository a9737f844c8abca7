"""Facts of the machine, and the bandwidth of its memory."""

import os
import platform
import re
import subprocess
from pathlib import Path
from typing import Any

VECTOR_FLAGS = ("sse4_2", "avx", "avx2", "fma", "avx512f", "avx512dq", "avx512vl", "asimd", "sve")


def _read(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""


def facts() -> dict[str, Any]:
    """What a reader needs to judge the figures by."""
    processor = _read("/proc/cpuinfo")
    model = re.search(r"model name\s*:\s*(.*)", processor)
    flags = re.search(r"flags\s*:\s*(.*)", processor)
    memory = re.search(r"MemTotal:\s*(\d+)", _read("/proc/meminfo"))
    caches = {}
    for index in range(4):
        folder = f"/sys/devices/system/cpu/cpu0/cache/index{index}"
        if _read(f"{folder}/type").strip() in ("Data", "Unified"):
            caches[f"L{_read(f'{folder}/level').strip()}"] = _read(f"{folder}/size").strip()
    present = set(flags.group(1).split()) if flags else set()
    return {
        "processor": model.group(1) if model else platform.processor(),
        "cores": os.cpu_count(),
        "caches": caches,
        "vector_flags": [flag for flag in VECTOR_FLAGS if flag in present],
        "memory_gib": round(int(memory.group(1)) / 2**20, 1) if memory else None,
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
    }


def triad(program: str | None, megabytes: float, threads: int) -> float | None:
    """Bandwidth of a = b + s c in three arrays of a total size [bytes/s], without counting the read before a write."""
    if program is None:
        return None
    done = subprocess.run([program, str(megabytes), str(threads)], capture_output=True, text=True, check=True)
    return float(done.stdout)
