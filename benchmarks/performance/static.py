"""Case: the static equilibrium of a beam under its weight, against scikit-fem and FElupe with their usual solvers."""

from pathlib import Path
from typing import Any

import numpy as np

from performance import problems
from performance.turns import Contender, Outcome, ratio, take_turns

ERROR = 1e-4
"""The largest error asked for, relative to the largest displacement."""

TOLERANCE = 1e-6
"""Relative residual that iterations are run to; it leaves an error below ``ERROR``."""


def run(quick: bool, peers_folder: Path, threads: tuple[int, ...]) -> dict[str, Any]:
    """Measures the whole solve, assembly included; errors are against the others' direct solutions."""
    count = max(threads)
    # FElupe factors in each of Newton's iterations, which takes many minutes for 100k cells
    sizes = {"linear": (68, 17, 17), "neo_hookean": (48, 12, 12)}
    plans = {
        "linear": [
            Contender("scikit-fem, sparse LU", "skfem_static.py", "skfem", {"solver": "direct"}),
            Contender("scikit-fem, conjugate gradients", "skfem_static.py", "skfem", {"solver": "gradients"}),
        ],
        "neo_hookean": [Contender("FElupe, sparse LU", "felupe_static.py", "felupe", {})],
    }
    groups = []
    for material, others in plans.items():
        cells = (16, 4, 4) if quick else sizes[material]
        problem = problems.cantilever(cells, (4.0, 1.0, 1.0), E=2e6, nu=0.3)
        own = [
            Contender(f"warpfem, {dtype}", "warpfem_static.py", "warpfem", {"dtype": dtype, "material": material})
            for dtype in ("float64", "float32")
        ]
        who = [
            Contender(c.name, c.script, c.peer, {"threads": count, "tolerance": TOLERANCE, **c.options})
            for c in [*own, *others]
        ]
        outcomes = take_turns(who, problem, 3 if quick else 1, peers_folder)
        rows = []
        for o in outcomes:
            row: dict[str, Any] = o.summary()
            if not o.missing:
                row["error"] = _error(o, outcomes)
                row.update({key: o.turns[-1][key] for key in ("iterations", "newton") if key in o.turns[-1]})
                if not outcomes[0].missing:
                    row["times_warpfem"] = ratio(o, outcomes[0])
            rows.append(row)
        groups.append({"cells": len(problem["cells"]), "material": material, "threads": count, "rows": rows})
    return {"groups": groups, "error": ERROR}


def _error(outcome: Outcome, outcomes: list[Outcome]) -> float:
    """The largest difference to a direct solution, or to warpfem's in double precision if there is none."""
    direct = [o for o in outcomes if not o.missing and o.contender.name.endswith("sparse LU")]
    reference = (direct or outcomes)[0].arrays["displacement"]
    return float(np.abs(outcome.arrays["displacement"] - reference).max() / np.abs(reference).max())
