"""The case on size: how much memory a million tetrahedra take."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import warp as wp

from warpfem.boundary import Pin
from warpfem.dtypes import FloatName
from warpfem.extremes.motion import DTYPES, NEWTON, VERLET, solver_name
from warpfem.extremes.table import Trial, at_most, case
from warpfem.materials import StableNeoHookean
from warpfem.mesh import Mesh
from warpfem.record import run
from warpfem.scene import Body, Scene
from warpfem.solvers import SOLVERS

MILLION = 1_000_000
LIMIT = 4.0
"""Peak memory [GB] of a million tetrahedra, what Python and its packages take included."""


@case(
    23,
    "1 million tetrahedra in under 4 GB",
    "The greatest resident memory of a process of its own that makes a pinned box of at least a million tetrahedra, "
    "takes three explicit steps, or one of backward Euler, and writes two frames to a USD file: below 4 GB. Quick: "
    "46305 tetrahedra, and as much in proportion beyond what the process has before the mesh.",
)
def a_million_cells(quick: bool) -> Iterator[Trial]:
    cubes = 21 if quick else 59
    for solver, dtype in product((VERLET, NEWTON), DTYPES[:1] if quick else DTYPES):
        label = f"{5 * cubes**3} tetrahedra, {dtype}, {solver_name(solver)}"
        arguments = json.dumps([cubes, solver.name, dtype])
        child = subprocess.run(
            [sys.executable, "-c", f"from warpfem.extremes.scale import tell; tell(*{arguments})"],
            capture_output=True,
            text=True,
        )
        if child.returncode:
            yield Trial(label, "FAIL", f"the process ended with {child.returncode}", child.stderr[-500:])
            continue
        before, peak = json.loads(child.stdout.splitlines()[-1])
        if quick:
            share = (LIMIT - before) * 5 * cubes**3 / MILLION
            yield at_most(f"{label}, beyond {before:.2g} GB", peak - before, share, " GB")
        else:
            yield at_most(label, peak, LIMIT, " GB")


def tell(cubes: int, solver_name: str, dtype: FloatName) -> None:
    """Runs a box of ``cubes``^3 cubes of five tetrahedra; prints the greatest memory before and after [GB]."""
    import warpfem.usd  # noqa: F401  a fixed cost, as are the kernels' compiler and the packages above

    wp.init()
    before = peak_memory()
    mesh = Mesh.box((1.0, 1.0, 1.0), (cubes, cubes, cubes))
    body = Body("box", mesh, StableNeoHookean(E=1e6, nu=0.3), supports=[Pin("left")])
    steps, dt = (3, 1e-5) if solver_name == VERLET.name else (1, 1e-2)
    scene = Scene([body], SOLVERS[solver_name](), dt=dt, gravity=(0.0, -9.81, 0.0), fps=1.0 / (steps * dt), frames=1)
    with TemporaryDirectory() as folder:
        run(scene, Path(folder) / "box.usdc", device="cpu", dtype=dtype)
    print(json.dumps([before, peak_memory()]))


def peak_memory() -> float:
    """The greatest resident memory of this process so far [GB]."""
    status = Path("/proc/self/status")
    if status.exists():  # getrusage() would begin with what the parent had
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024 / 1e9
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9
