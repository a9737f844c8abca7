"""Contact: a column that rests on a plane, and a disc pressed into a block."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import brentq

import warpfem as wf
from verification.core import Case, Check, Table, at_most, between, orders
from verification.hyperelastic import lame
from verification.models import body, mapped, model_of, solved
from verification.simplex import boundary_loads, boundary_quadrature
from warpfem.scene import ELEMENTS

# a column of 1 x 2 between smooth walls, on a plane with a stiffness in Pa/m
HEIGHT, E, NU, WEIGHT, STIFFNESS = 2.0, 1.0, 0.3, 0.2, 40.0

# a disc pressed into a block of 2 x 1
RADIUS, INDENTATION, DISC_NU, DISC_STIFFNESS = 4.0, 2.5e-3, 0.3, 1e4
GRADING = 5.0
"""Cells grow by the factor cosh(5) = 74 from the contact to the far sides."""


def settling(material: str) -> tuple[float, float]:
    """How far the bottom and the top of the column move, by integration of its balance in one dimension [m].

    The nominal stress at the height Y is -w (H - Y), with w the weight per volume, and the stretch s follows from
    P(s) = mu (s - 1/s) + lam ln(s)/s, or (2 mu + lam)(s - 1) if linear; the pressure at the bottom is the weight.
    """
    mu, lam = lame(E, NU)

    def stretch(stress: float) -> float:
        if material == "linear":
            return 1.0 + stress / (2.0 * mu + lam)
        return float(brentq(lambda s: mu * (s - 1.0 / s) + lam * np.log(s) / s - stress, 1e-3, 1.0, xtol=1e-14))

    x, weights = np.polynomial.legendre.leggauss(40)
    shortening = sum(
        0.5 * HEIGHT * w * (stretch(-WEIGHT * 0.5 * HEIGHT * (t + 1.0)) - 1.0) for t, w in zip(x, weights, strict=True)
    )
    bottom = -WEIGHT * HEIGHT / STIFFNESS
    return bottom, bottom + float(shortening)


def settled(material: str, n: int, element: str) -> tuple[float, float]:
    """The same by warpfem: backward Euler with long steps, to rest; means over each side."""
    mesh = wf.Mesh.rectangle((1.0, HEIGHT), (n, 2 * n))
    walls = [wf.Pin("left", axes=(0,)), wf.Pin("right", axes=(0,))]
    column = body(mesh, wf.MATERIALS[material](E=E, nu=NU), element, density=WEIGHT, supports=walls)
    model = model_of(column, gravity=(0.0, -1.0), obstacles=[wf.Plane((0, 0), (0, 1), stiffness=STIFFNESS)])
    state, stepper = model.state(), wf.BackwardEuler(tolerance=1e-9).stepper(model)
    for _ in range(40):
        stepper.step(state, 100.0)
        if np.abs(state.velocity).max() * 100.0 < 1e-9:
            break
    shape = model.scene.bodies[0].mesh
    shares = [side_shares(shape, sign) for sign in (-1.0, 1.0)]
    bottom, top = (float(share @ state.displacement[:, 1] / share.sum()) for share in shares)
    return bottom, top


def side_shares(mesh: wf.Mesh, sign: float) -> np.ndarray:
    """The integrals of the shape functions (n,) over the faces that look down, sign -1, or up, +1."""
    _, weights, N, normals = boundary_quadrature(mesh)
    on_side = np.broadcast_to((sign * normals[:, 1] > 0.9)[:, None, None], (*weights.shape, 1))
    return boundary_loads(mesh, on_side.astype(float), weights, N)[:, 0]


def pressed(n: int, element: str) -> tuple[np.ndarray, np.ndarray, float]:
    """A disc pressed into half a block, symmetric about x = 0, by warpfem.

    Returns:
        Places x of the points on the top, their contact pressures, and the force on the whole block [N/m].
    """

    def place(x: np.ndarray) -> np.ndarray:
        finer = np.sinh(GRADING * np.stack([x[:, 0], 1.0 - x[:, 1]], axis=1)) / np.sinh(GRADING)
        return finer * (1.0, -1.0)

    mesh = mapped(wf.Mesh.rectangle((1, 1), (n, n)), place)
    supports = [wf.Pin("left", axes=(0,)), wf.Pin("bottom")]
    block = body(mesh, wf.LinearElasticity(E=E, nu=DISC_NU), element, supports=supports)
    disc = wf.Sphere((0.0, RADIUS - INDENTATION), RADIUS, stiffness=DISC_STIFFNESS)
    model = model_of(block, obstacles=[disc])
    state = solved(model, tolerance=1e-8)
    mesh = model.scene.bodies[0].mesh
    top = mesh.point_sets["top"]
    top = top[np.argsort(model.rest_points[top, 0])]
    force = -model.internal_force(state)[top, 1]  # of the disc on the points, downwards
    return model.rest_points[top, 0], -force / side_shares(mesh, 1.0)[top], -2.0 * float(force.sum())


def run(quick: bool) -> Iterator[Check | Table]:
    for element in ELEMENTS:
        for material in ("linear",) if quick else ("linear", "neo_hookean"):
            exact = settling(material)
            counts = (2, 4) if quick else (4, 8, 16)
            found = [settled(material, n, element) for n in counts]
            errors = [abs(top / exact[1] - 1.0) for _, top in found]
            rows = [
                [f"{n} x {2 * n}", f"{bottom:.6f}", f"{top:.6f}", f"{100 * error:.3f} %"]
                for n, (bottom, top), error in zip(counts, found, errors, strict=True)
            ]
            rows.append(["exact", *(f"{u:.6f}" for u in exact), ""])
            where = f"{material}, {element}"
            yield Table(f"Column on a plane, {where}", ["cells", "bottom", "top", "error"], rows)
            yield at_most(f"sinking of the bottom, {where}", abs(found[-1][0] / exact[0] - 1.0), 1e-6)
            if material == "linear":
                yield at_most(f"sinking of the top, {where}", errors[-1], 1e-6)
            elif element == "averaged":  # its error changes sign, so that it has no order on these meshes
                yield at_most(f"sinking of the top, {where}", errors[-1], 1e-4)
            else:
                yield between(
                    f"order of the top's error, {where}", orders([1 / n for n in counts], errors)[-1], 1.8, 5.0
                )
        if not quick:
            yield from _hertz(element)


def _hertz(element: str) -> Iterator[Check | Table]:
    modulus = E / (1.0 - DISC_NU**2)
    rows = []
    for n in (32, 64):
        x, pressure, force = pressed(n, element)
        half_width = np.sqrt(4.0 * force * RADIUS / (np.pi * modulus))
        peak = 2.0 * force / (np.pi * half_width)
        inner = x < 0.8 * half_width
        # p^2 falls linearly with x^2, to 0 at the half-width
        slope, start = np.polyfit(x[inner] ** 2, pressure[inner] ** 2, 1)
        found = np.sqrt(start), np.sqrt(-start / slope)
        rows.append(
            [f"{n} x {n}", f"{force:.4e}", f"{found[0]:.4e}", f"{peak:.4e}", f"{found[1]:.5f}", f"{half_width:.5f}"]
        )
    head = ["cells of half the block", "force", "peak pressure", "Hertz", "half-width", "Hertz"]
    yield Table(f"Disc pressed into a block, {element}", head, rows)
    yield at_most(f"peak pressure, {element}", abs(found[0] / peak - 1.0), 0.01)
    yield at_most(f"half-width of the contact, {element}", abs(found[1] / half_width - 1.0), 0.01)


CASE = Case(
    name="contact",
    title="Contact",
    what=(
        "A column of 1 x 2, E = 1, nu = 0.3, under a weight of 0.2 per volume, between smooth walls, on a plane of "
        "stiffness 40; and a rigid disc of radius 4 pressed 0.0025 into a linear block of 2 x 1, clamped below, E = 1, "
        "nu = 0.3. The contact stiffness is part of the column's exact solution; for the disc it is 1e4, which lets it "
        "sink in by 0.1 % of the indentation."
    ),
    reference=(
        "the column: the balance in one dimension, integrated by Gauss quadrature. The disc: Hertz's line contact, "
        "a^2 = 4 P R/(pi E*), p0 = 2 P/(pi a), E* = E/(1 - nu^2) (Johnson, Contact mechanics, 1985, section 4.2), from "
        "the force P that is found. Hertz has a half-space and a parabola, good to (a/H)^2 = 0.6 % here."
    ),
    criterion=(
        "the mean over the bottom is right to 1e-6, so is that over the top where the column is linear (a linear field "
        "does work on it, and that is in the space of every element); else its error falls at least with order 1.8, "
        "or with averaged cells, where it changes sign, is at most 1e-4; peak pressure and half-width within 1 % of "
        "Hertz's."
    ),
    run=run,
)
