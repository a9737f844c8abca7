"""Case: how warpfem's cost grows with cells, unknowns and threads."""

import os
from pathlib import Path
from typing import Any

from performance import problems
from performance.turns import Contender, take_turns

SIDES = (6, 10, 15, 26, 41, 55, 69)
"""Cubes along a side of the shaken cube: 1k to 2M cells."""

BEAMS = ((32, 8, 8), (56, 14, 14), (100, 25, 25), (172, 43, 43))
"""Cubes of a beam: 8k, 39k, 209k and 1M unknowns."""


def run(quick: bool, peers_folder: Path, threads: tuple[int, ...]) -> dict[str, Any]:
    """Measures explicit steps on growing meshes, and the iterations of multigrid in static solves."""
    counts = sorted({*threads, os.cpu_count() or 1})
    explicit = []
    for side in SIDES[:2] if quick else SIDES:
        problem = problems.shaken_cube(side)
        cells = len(problem["cells"])
        steps = max(5, min(500, 10_000_000 // cells))
        options = {"material": "stable_neo_hookean", "steps": steps}
        who = [Contender("warpfem", "warpfem_explicit.py", "warpfem", {**options, "threads": n}) for n in counts]
        for outcome in take_turns(who, problem, 3 if quick else 9, peers_folder, budget=20.0):
            bytes_per_cell = outcome.ready.get("device_bytes", 0) / cells
            explicit.append({**outcome.summary(), "cells": cells, "bytes_per_cell": bytes_per_cell})
    static = []
    for beam in ((8, 2, 2), (16, 4, 4)) if quick else BEAMS:
        problem = problems.cantilever(beam, (4.0, 1.0, 1.0), E=2e6, nu=0.3)
        options = {"material": "linear", "dtype": "float64", "tolerance": 1e-6, "threads": max(counts)}
        options["linear_solver"] = "multigrid"
        (outcome,) = take_turns(
            [Contender("warpfem", "warpfem_static.py", "warpfem", options)], problem, 1, peers_folder
        )
        told = {} if outcome.missing else {key: outcome.turns[-1][key] for key in ("newton", "iterations")}
        static.append({**outcome.summary(), "unknowns": 3 * len(problem["points"]), **told})
    return {"explicit": explicit, "static": static}
