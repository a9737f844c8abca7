"""Reports what has become slower than it was, in ratios that hardly depend on the machine. Never fails.

    python benchmarks/performance/guard.py [--update]

Times are relative to that of a NumPy sum of arrays on the same machine, taken in between. ``--update`` stores what is
found as the baseline.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import warpfem as wf
from warpfem.linear import tangent_operator
from warpfem.model import Model
from warpfem.simulation import Simulation

BASELINE = Path(__file__).with_name("guard.json")

MARGIN = 2.0
"""How many times its baseline a ratio may be before it is told."""

TURNS = 9


def _seconds(action: Callable[[], object], times: int) -> float:
    start = time.perf_counter()
    for _ in range(times):
        action()
    return (time.perf_counter() - start) / times


def measured() -> dict[str, float]:
    """The time of each action over that of the sum, the median over turns."""
    mesh = wf.Mesh.box((1.0, 1.0, 1.0), (16, 16, 16), split=5)
    body = wf.Body("box", mesh, wf.StableNeoHookean(E=1e5, nu=0.3))

    def stepping(solver: wf.solvers.Solver, dt: float) -> Callable[[], object]:
        scene = wf.Scene([body], solver, gravity=(0.0, -9.81, 0.0), dt=dt, fps=1.0 / dt, frames=1)
        simulation = Simulation(scene, threads=1)
        return lambda: simulation.stepper.step(simulation.state, dt)

    model = Model(wf.Scene([body], wf.BackwardEuler()))
    operator = tangent_operator(model, "assembled")
    operator.linearize(model.state().u, 1.0)
    p, product = model.zeros(), model.zeros()
    actions = {
        "explicit step": (stepping(wf.SymplecticEuler(), 1e-4), 20),
        "implicit step": (stepping(wf.BackwardEuler.linearised(), 1e-2), 1),
        "product with the assembled stiffness": (lambda: operator.apply(p, product), 20),
    }
    a, b, c = (np.ones(1_000_000, dtype=np.float32) for _ in range(3))
    ratios: dict[str, list[float]] = {name: [] for name in actions}
    for _turn in range(TURNS):
        for name, (action, times) in actions.items():
            unit = _seconds(lambda: np.add(b, c, out=a), 5)
            ratios[name].append(_seconds(action, times) / unit)
    return {name: statistics.median(values) for name, values in ratios.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--update", action="store_true", help="store what is found as the baseline")
    found = measured()
    if parser.parse_args().update:
        BASELINE.write_text(json.dumps({name: round(value, 3) for name, value in found.items()}, indent=2) + "\n")
    baseline = json.loads(BASELINE.read_text())
    for name, value in found.items():
        times = value / baseline[name]
        warning = "" if times <= MARGIN else f"  WARNING: {MARGIN:g} times its baseline is exceeded"
        print(f"{name}: {times:.2f} of its baseline{warning}")


if __name__ == "__main__":
    main()
