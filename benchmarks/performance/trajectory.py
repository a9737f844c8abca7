"""Case: the swing of a cantilever to 1 % of its peak, against Newton's solvers; each at the cheapest setting for that.

Newton's vertex block descent has a stable Neo-Hookean energy without the logarithm, its semi-implicit solver the one
with it, which is warpfem's. Each is compared with a converged motion of its own material.
"""

import statistics
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warpfem as wf
from performance import problems
from performance.turns import Contender, Outcome, take_turns
from warpfem.simulation import Simulation

ERROR = 0.01
"""The error asked for, relative to the peak."""

DURATION = 0.8
"""About one period of the swing [s]."""

SAMPLES = 16

# steps in each of the intervals between samples, of which explicit ones need 68 to be stable; for vertex block descent
# also iterations a step
OWN_STEPS = {
    "linearised": (40, 80, 120),
    "implicit_midpoint": (2, 4),
    "sdirk2": (2, 4),
    "sdirk3": (1, 2),
    "symplectic_euler": (76, 150),
    "velocity_verlet": (76, 150),
}
SEMI_IMPLICIT_STEPS = (76, 150)
DESCENT_SETTINGS = ((80, 5), (100, 3), (100, 5), (150, 2), (200, 2), (600, 1))


@wp.func
def _without_logarithm(F: wp.mat33d, parameters: wp.types.vector(length=2, dtype=wp.float64)):
    mu = parameters[0]
    lam = parameters[1] + mu
    gap = wp.determinant(F) - wp.float64(1.0)
    return wp.float64(0.5) * mu * (wp.ddot(F, F) - wp.float64(3.0)) - mu * gap + wp.float64(0.5) * lam * gap * gap


def _reference(problem: dict[str, Any], material: wf.materials.base.Material) -> np.ndarray:
    """Displacements at the samples, by velocity Verlet in float64 with steps whose error is far below 1e-4."""
    mesh = wf.Mesh(problem["points"], problem["cells"]).with_point_set("fixed", np.flatnonzero(problem["fixed"]))
    body = wf.Body("beam", mesh, material, density=problem["density"], supports=[wf.Pin("fixed")])
    interval, steps = DURATION / SAMPLES, 500
    gravity = (0.0, problem["gravity"], 0.0)
    scene = wf.Scene(
        [body], wf.VelocityVerlet(), gravity=gravity, dt=interval / steps, fps=1.0 / interval, frames=SAMPLES
    )
    frames = list(Simulation(scene, dtype="float64").frames())
    return np.array([frame.displacement for frame in frames[1:]])


def run(quick: bool, peers_folder: Path, threads: tuple[int, ...]) -> dict[str, Any]:
    """Runs all settings of all contenders and finds the cheapest of each that is accurate enough."""
    cells = (5, 1, 1) if quick else (20, 4, 4)
    problem = problems.cantilever(cells, (1.0, 0.25, 0.25), E=1e6, nu=0.3)
    mu, lam = problem["E"] / 2.6, problem["E"] * 0.3 / (1.3 * 0.4)
    motions = {
        "with logarithm": _reference(problem, wf.StableNeoHookean(E=problem["E"], nu=problem["nu"])),
        "without": _reference(problem, wf.EnergyMaterial(_without_logarithm, {"mu": mu, "lam": lam})),
    }
    shared = {**problem, "interval": DURATION / SAMPLES}
    own = {f"{scheme}, {n} steps": (scheme, n) for scheme, counts in OWN_STEPS.items() for n in counts}
    descent = {f"{n} steps, {i} iterations": (n, i) for n, i in DESCENT_SETTINGS}
    semi = {f"{n} steps": (n, 0) for n in SEMI_IMPLICIT_STEPS}
    plans = {
        "with logarithm": [
            Contender("warpfem", "warpfem_trajectory.py", "warpfem", {"settings": own, "threads": 1}),
            Contender("Newton semi-implicit", "newton_trajectory.py", "newton", {"settings": semi, "solver": "semi"}),
        ],
        "without": [Contender("Newton VBD", "newton_trajectory.py", "newton", {"settings": descent, "solver": "vbd"})],
    }
    rows = []
    for energy, who in plans.items():
        given = {**shared, "reference": motions[energy]}
        for outcome in take_turns(who, given, 1 if quick else 2, peers_folder):
            rows.append({**outcome.summary(), "energy": energy, "settings": _settings(outcome)})
    peak = float(np.linalg.norm(motions["with logarithm"], axis=2).max())
    return {"rows": rows, "cells": len(problem["cells"]), "peak": peak, "duration": DURATION, "error": ERROR}


def _settings(outcome: Outcome) -> list[dict[str, Any]]:
    """Each setting with its error and its wall time for a second of motion, the cheapest accurate one marked."""
    if outcome.missing:
        return []
    settings = []
    for name in outcome.turns[0]["settings"]:
        seconds = statistics.median(turn["settings"][name]["seconds"] for turn in outcome.turns)
        error = outcome.turns[-1]["settings"][name]["error"]
        settings.append({"name": name, "error": error, "seconds": seconds / DURATION, "chosen": False})
    accurate = [s for s in settings if s["error"] <= ERROR]
    if accurate:
        min(accurate, key=lambda s: s["seconds"])["chosen"] = True
    return settings
