"""Case: how long it takes until the first step, in a fresh process with a warm cache of kernels and with none."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

_SCENE = """
import warpfem as wf
from warpfem.simulation import Simulation
mesh = wf.Mesh.box((1.0, 1.0, 1.0), ({n}, {n}, {n}), origin=(0.0, 0.1, 0.0), split=5)
body = wf.Body("box", mesh, wf.StableNeoHookean(E=1e5, nu=0.3))
scene = wf.Scene([body], {solver}, obstacles=[wf.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))])
Simulation(scene)
"""


def _process(arguments: list[str], cache: str | None = None) -> float:
    """The wall time of a fresh interpreter [s]."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **({"WARP_CACHE_PATH": cache} if cache else {})}
    start = time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, env=environment, capture_output=True)
    return time.perf_counter() - start


def run(quick: bool, peers_folder: Path, threads: tuple[int, ...]) -> dict[str, Any]:
    """Measures whole processes."""
    side, repeats = (6, 1) if quick else (27, 5)
    seconds = {"import warpfem": median(_process(["-c", "import warpfem"]) for _ in range(repeats))}
    for solver in ("wf.SymplecticEuler()", "wf.BackwardEuler()"):
        code = ["-c", _SCENE.format(n=side, solver=solver)]
        _process(code)
        name = f"import, build and finalise {5 * side**3:,} cells, {solver[3:-2]}"
        seconds[name] = median(_process(code) for _ in range(repeats))
    scene = str(ROOT / "scenes" / "jelly_drop.py")
    with tempfile.TemporaryDirectory() as folder:
        command = ["-m", "warpfem", "run", scene, "--out", f"{folder}/jelly.usdc", "--overwrite"]
        cold = _process(command, cache=f"{folder}/cache")
        warm = median(_process(command, cache=f"{folder}/cache") for _ in range(repeats))
    seconds["run scenes/jelly_drop.py, all compiled before"] = warm
    seconds["compile what scenes/jelly_drop.py needs (the first run less the others)"] = cold - warm
    return {"seconds": seconds}
