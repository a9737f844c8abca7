"""Case: a linearised step of backward Euler, against Taichi's implicit FEM example."""

from pathlib import Path
from typing import Any

from performance import problems
from performance.turns import Contender, ratio, take_turns

TOLERANCE = 1e-6

WAYS = ("shipped", "rewritten", "factored")

OWN = {
    "warpfem, fixed corotated": "fixed_corotated",
    "warpfem, stable Neo-Hookean": "stable_neo_hookean",
}


def run(quick: bool, peers_folder: Path, threads: tuple[int, ...]) -> dict[str, Any]:
    """Measures the step from a deformed state at rest; true residuals are computed in float64."""
    side = 6 if quick else 15
    problem = {**problems.shaken_cube(side), "E": 5e4, "nu": 0.0, "dt": 1e-2}
    groups = []
    for count in threads[:1] if quick else threads:
        # rounding leaves a solve a little above what it claims, so that half is asked for
        shared = {"threads": count, "tolerance": TOLERANCE / 2}
        who = [
            Contender(name, "warpfem_implicit.py", "warpfem", {**shared, "material": material, "settings": {}})
            for name, material in OWN.items()
        ]
        who += [Contender(f"Taichi {w}", "taichi_implicit.py", "taichi", {**shared, "way": w}) for w in WAYS]
        outcomes = take_turns(who, problem, 3 if quick else 15, peers_folder)
        rows = []
        for o in outcomes:
            row: dict[str, Any] = o.summary()
            if not o.missing:
                row["residual"] = float(o.arrays["residual"][0])
                row["iterations"] = o.turns[-1]["iterations"]
                if not outcomes[0].missing:
                    row["times_warpfem"] = ratio(o, outcomes[0])
            rows.append(row)
        groups.append({"cells": len(problem["cells"]), "threads": count, "rows": rows})
    return {"groups": groups, "tolerance": TOLERANCE}
