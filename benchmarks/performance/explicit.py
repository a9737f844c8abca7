"""Case: a step of symplectic Euler, against a C++ program written by hand, Taichi and Newton."""

from pathlib import Path
from typing import Any

import numpy as np

from performance import machine, peers, problems
from performance.turns import Contender, Outcome, ratio, take_turns

MATERIALS = ("stable_neo_hookean", "neo_hookean", "fixed_corotated")

LIMIT_VARIANTS = ("scalar", "lanes16", "strips3x16", "strips3x8")

TAICHI_WAYS = ("atomic", "serial", "sums", "tape")

STEP_BYTES = 76
"""Least memory traffic of a cell in a step [bytes]: 16 of corners, 36 of D^-1, 12 of volume and parameters, and its
share of the points, a fifth of 24 + 24 + 12 for u, v and the inverse mass, read and written."""


def contenders(material: str, threads: int, steps: int, binary: str | None, plain: bool) -> list[Contender]:
    """Who takes part; ``plain`` leaves out those that are slow beyond interest on large meshes."""
    shared = {"material": material, "threads": threads, "steps": steps}
    who = [Contender("warpfem", "warpfem_explicit.py", "warpfem", shared)]
    for variant in LIMIT_VARIANTS if binary else ():
        who.append(Contender(f"C++ {variant}", "limit.py", "warpfem", {**shared, "binary": binary, "variant": variant}))
    for way in TAICHI_WAYS:
        if (way == "serial" and threads > 1) or (way == "tape" and (plain or material == "fixed_corotated")):
            continue
        who.append(Contender(f"Taichi {way}", "taichi_explicit.py", "taichi", {**shared, "way": way}))
    if material == "stable_neo_hookean" and threads == 1 and not plain:
        who.append(Contender("Newton, semi-implicit", "newton_explicit.py", "newton", shared))
    return who


def disagreement(outcome: Outcome, reference: Outcome, name: str) -> float:
    """The largest difference of an array relative to its largest entry."""
    expected = reference.arrays[name]
    free = np.abs(outcome.arrays[name]).max(axis=1) > 0.0  # some tell no force of fixed points
    return float(np.abs(outcome.arrays[name] - expected)[free].max() / np.abs(expected).max())


def run(quick: bool, peers_folder: Path, threads: tuple[int, ...]) -> dict[str, Any]:
    """Measures and compares; the result is plain data for the page."""
    binary = peers.compiled("limit.cpp", peers_folder)
    plan = [(26, material, n) for material in MATERIALS for n in threads]
    plan += [(15, "stable_neo_hookean", n) for n in threads] + [(55, "stable_neo_hookean", n) for n in threads]
    if quick:
        plan = [(10, "stable_neo_hookean", threads[0])]
    groups = []
    for side, material, count in plan:
        problem = problems.shaken_cube(side)
        cells = len(problem["cells"])
        steps = max(5, min(500, 10_000_000 // cells))
        who = contenders(material, count, steps, binary, plain=side > 30)
        print(f"  {cells} cells, {material}, threads: {count}", flush=True)
        outcomes = take_turns(who, problem, 3 if quick else 9, peers_folder, budget=15.0)
        groups.append(_group(cells, material, count, outcomes))
    triad = peers.compiled("triad.cpp", peers_folder)
    bandwidth = [
        {"megabytes": size, "threads": n, "bytes_per_second": machine.triad(triad, size, n)}
        for n in threads
        for size in (1.0, 8.0, 64.0, 512.0)
    ]
    return {"groups": groups, "triad": bandwidth, "step_bytes": STEP_BYTES}


def _group(cells: int, material: str, threads: int, outcomes: list[Outcome]) -> dict[str, Any]:
    present = [o for o in outcomes if not o.missing]
    own = next((o for o in present if o.contender.peer == "warpfem" and "variant" not in o.contender.options), None)
    reference = own or (present[0] if present else None)
    rows = []
    for o in outcomes:
        row: dict[str, Any] = o.summary()
        if not o.missing:
            row["rate"] = cells / o.median
            row["best_rate"] = cells / o.best
            row["force_difference"] = disagreement(o, reference, "forces")
            row["displacement_difference"] = disagreement(o, reference, "displacement")
            if own is not None:
                row["times_warpfem"] = ratio(o, own)
        rows.append(row)
    return {"cells": cells, "material": material, "threads": threads, "rows": rows}
