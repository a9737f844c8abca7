"""Cantilevers in small and large deflection."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from scipy.integrate import solve_bvp

import warpfem as wf
from verification.core import Case, Check, Table, at_most, between, orders
from verification.hyperelastic import lame, linear, neo_hookean
from verification.models import body, model_of, solved
from verification.spectral import box, graded
from warpfem.scene import ELEMENTS

NU = 0.3

# 3D: a beam of 4 x 1 x 1 under its weight, E = 2e7, density 1000, g = 9.81, linear
SIZE, E, DENSITY, GRAVITY = (4.0, 1.0, 1.0), 2e7, 1000.0, 9.81
SAG = -0.19643
"""Its vertical displacement at the middle of the free end by :func:`sag` [m]: -0.196417 with p = 5 and 3
levels, -0.196420 with p = 4 and 4 levels; good to 1e-4."""

# 2D: a strip of 10 x 1, E = 1, Neo-Hookean, with an even dead traction on its end
SLENDER, LARGE_FORCE = (10.0, 1.0), 0.002
LARGE = (-1.80054, 5.23162)
"""The displacement at the middle of the free end by :func:`large_deflection` with p = 8 and 4 levels [m]."""


def sag(p: int, levels: int) -> float:
    """The sag of the beam by spectral elements, on the half z < 1/2 (by symmetry)."""
    divisions = [graded(levels, "left"), graded(levels), graded(levels, "left")]
    grid = box((SIZE[0], SIZE[1], 0.5 * SIZE[2]), divisions, p)
    held = np.zeros((len(grid.points), 3), dtype=bool)
    held[grid.side(0, 0)] = True
    held[grid.side(2, -1), 2] = True
    u = grid.solve(linear, *lame(E, NU), held, grid.body_load((0.0, -DENSITY * GRAVITY, 0.0)))
    return float(grid.value(u, (1.0, 0.5, 1.0))[1])


def large_deflection(p: int, levels: int) -> tuple[float, float]:
    """The displacement of the strip's end by spectral elements."""
    grid = box(SLENDER, [graded(levels), graded(levels)], p)
    held = np.zeros((len(grid.points), 2), dtype=bool)
    held[grid.side(0, 0)] = True
    u = grid.solve(neo_hookean, *lame(1.0, NU), held, grid.side_load(0, -1, (0.0, LARGE_FORCE)), steps=6)
    x, y = grid.value(u, (1.0, 0.5))
    return float(x), float(y)


def timoshenko() -> float:
    """The sag by Timoshenko's beam: bending and shear, kappa = 5/6."""
    w, inertia = DENSITY * GRAVITY, 1.0 / 12.0
    return -w * SIZE[0] ** 4 / (8.0 * E * inertia) - w * SIZE[0] ** 2 / (2.0 * 5.0 / 6.0 * lame(E, NU)[0])


def elastica() -> tuple[float, float]:
    """The displacement of the end of an inextensible strip in plane strain (Bisshopp and Drucker 1945)."""
    load = LARGE_FORCE * SLENDER[0] ** 2 * 12.0 * (1.0 - NU**2)
    s = np.linspace(0.0, 1.0, 101)
    found = solve_bvp(
        lambda s, y: np.stack([y[1], -load * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]),
        lambda a, b: np.array([a[0], b[1], a[2], a[3]]),
        s,
        np.stack([s, 1.0 - s, s, 0.5 * s**2]),
        tol=1e-8,
    )
    return SLENDER[0] * (found.y[2, -1] - 1.0), SLENDER[0] * found.y[3, -1]


def at_end(model, u: np.ndarray, size: tuple[float, ...]) -> np.ndarray:
    """The displacement at the middle of the free end."""
    end = np.array([size[0], *(0.5 * s for s in size[1:])])
    return u[np.argmin(np.linalg.norm(model.rest_points - end, axis=1))]


def heavy_beam(n: int, element: str, split: Literal[5, 6]) -> tuple[int, float]:
    """Unknowns, and the sag by warpfem with n cubes of 5 or 6 tetrahedra across the height."""
    mesh = wf.Mesh.box(SIZE, (4 * n, n, n), split=split)
    beam = body(mesh, wf.LinearElasticity(E=E, nu=NU), element, density=DENSITY, supports=[wf.Pin("left")])
    model = model_of(beam, gravity=(0.0, -GRAVITY, 0.0))
    unknowns = 3 * (model.point_count - model.supports.count)
    return unknowns, float(at_end(model, solved(model, tolerance=1e-8).displacement, SIZE)[1])


def bent_strip(n: int, element: str) -> np.ndarray:
    """The displacement of the strip's end by warpfem with n squares across the height."""
    mesh = wf.Mesh.rectangle(SLENDER, (10 * n, n))
    loads = [wf.Traction("right", (0.0, LARGE_FORCE))]
    model = model_of(body(mesh, wf.NeoHookean(E=1.0, nu=NU), element, supports=[wf.Pin("left")], loads=loads))
    return at_end(model, solved(model, tolerance=1e-8).displacement, SLENDER)


def run(quick: bool) -> Iterator[Check | Table]:
    if not quick:
        yield at_most("the reference in 3D with p = 4", abs(sag(4, 2) / SAG - 1.0), 2e-3)
        again = np.array(large_deflection(6, 2))
        yield at_most("the reference in 2D with p = 6", float(np.abs(again / LARGE - 1.0).max()), 1e-3)
    for element in ELEMENTS:
        finest = 8 if element == "quadratic" else 16
        for split in () if quick else (5, 6) if element == "linear" else (5,):
            yield from _small(element, (finest // 4, finest // 2, finest), split)
        yield from _large(element, (finest // 4, finest // 2) if quick else (finest // 4, finest // 2, finest))


def _small(element: str, counts: tuple[int, ...], split: Literal[5, 6]) -> Iterator[Check | Table]:
    found = [heavy_beam(n, element, split) for n in counts]
    errors = [w / SAG - 1.0 for _, w in found]
    rows = [
        [f"{unknowns}", f"{w:.5f}", f"{100 * error:.1f} %"] for (unknowns, w), error in zip(found, errors, strict=True)
    ]
    rows.append(["exact", f"{SAG:.5f}", ""])
    rows.append(["Timoshenko's beam", f"{timoshenko():.5f}", f"{100 * (timoshenko() / SAG - 1):.1f} %"])
    yield Table(
        f"Beam of 4 x 1 x 1 under its weight, {split} {element} tetrahedra per cube",
        ["unknowns", "sag of the end", "error"],
        rows,
    )
    yield _converging(f"sag with {split} tetrahedra per cube", element, counts, np.abs(errors).tolist())


def _large(element: str, counts: tuple[int, ...]) -> Iterator[Check | Table]:
    found = [bent_strip(n, element) for n in counts]
    errors = [float(np.linalg.norm(u - LARGE) / np.linalg.norm(LARGE)) for u in found]
    rows = [
        [f"{10 * n} x {n}", f"{u[0]:.4f}", f"{u[1]:.4f}", f"{100 * error:.2f} %"]
        for n, u, error in zip(counts, found, errors, strict=True)
    ]
    curve = np.array(elastica())
    rows.append(["exact", *(f"{c:.4f}" for c in LARGE), ""])
    difference = np.linalg.norm(curve - LARGE) / np.linalg.norm(LARGE)
    rows.append(["elastica", *(f"{c:.4f}" for c in curve), f"{100 * difference:.2f} %"])
    yield Table(f"Strip of 10 x 1, bent by a force on its end, {element}", ["cells", "along", "across", "error"], rows)
    yield _converging("bent strip", element, counts, errors)


def _converging(what: str, element: str, counts: tuple[int, ...], errors: list[float]) -> Check:
    """Linear cells converge with order 2; what limits quadratic ones is the singularity at the clamp."""
    if element == "quadratic":
        return at_most(f"error on the finest mesh, {what}, {element}", errors[-1], 3e-3)
    return between(f"order, {what}, {element}", orders([1.0 / n for n in counts], errors)[-1], 1.7, 2.3)


CASE = Case(
    name="cantilever",
    title="Cantilevers in small and large deflection",
    what=(
        "A linear beam of 4 x 1 x 1, E = 2e7, density 1000, clamped at one end, under g = 9.81; and a Neo-Hookean "
        "strip of "
        f"10 x 1 in plane strain, E = 1, with an even dead traction of {LARGE_FORCE:g} across its end; nu = 0.3."
    ),
    reference=(
        "spectral elements graded towards the clamped end (benchmarks/verification/spectral.py), recomputed here with "
        "a lower degree. For comparison: Timoshenko's beam with bending and shear, kappa = 5/6; and the elastica "
        "(Bisshopp and Drucker 1945, Q. Appl. Math. 3, 272), which neither stretches nor shears."
    ),
    criterion=(
        "linear cells: the error falls with order 2 (1.7 to 2.3) between the two finest meshes; quadratic cells: it is "
        "below 0.3 % on the finest mesh, where the singularity at the clamp limits the order."
    ),
    run=run,
)
