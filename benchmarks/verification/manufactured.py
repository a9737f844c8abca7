"""Manufactured solutions: the orders of convergence in L2 and H1."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

import warpfem as wf
from verification.core import Case, Check, Table, between, orders
from verification.hyperelastic import STRESSES, Stress
from verification.models import ORDERS, body, model_of, point_forces, solved
from verification.simplex import Field, boundary_loads, boundary_quadrature
from warpfem.materials import HookeanMaterial
from warpfem.scene import ELEMENTS

MATERIALS = {"linear": wf.LinearElasticity, "neo_hookean": wf.NeoHookean}
E, NU = 1.0, 0.3

# u_i = A sin(k_i . X + phi_i)
AMPLITUDE = 0.1
WAVES = {
    2: (np.array([[2.0, 1.0], [1.0, -1.5]]), np.array([0.3, 1.2])),
    3: (np.array([[1.5, 0.8, -0.6], [0.7, -1.4, 0.9], [-0.5, 1.1, 1.6]]), np.array([0.3, 1.2, 0.7])),
}
HELD = {2: ("left", "bottom", "top"), 3: ("left", "bottom", "top", "back", "front")}
"""Where u is prescribed; on the right side the traction is. (Dead pressure on all sides of a corner would turn it over:
then the manufactured state is an equilibrium, but no stable one.)"""


def displacement(X: np.ndarray) -> np.ndarray:
    """The manufactured u (..., dim) at places X (..., dim), which may be complex."""
    k, phase = WAVES[X.shape[-1]]
    return AMPLITUDE * np.sin(X @ k.T + phase)


def gradient(X: np.ndarray) -> np.ndarray:
    """Its gradient (..., dim, dim)."""
    k, phase = WAVES[X.shape[-1]]
    return AMPLITUDE * np.cos(X @ k.T + phase)[..., None] * k


def body_force(stress: Stress, X: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """-Div P (..., dim), each derivative by a complex step, exact to rounding."""
    dim = X.shape[-1]
    divergence = np.zeros(X.shape)
    for j in range(dim):
        F = np.eye(dim) + gradient(X + 1e-30j * np.eye(dim)[j])
        divergence += 1e30 * stress(F, mu, lam)[..., j].imag
    return -divergence


def unit_mesh(dim: int, n: int, perturbed: bool) -> wf.Mesh:
    """The unit square or cube in n^dim squares or cubes; perturbed, inner points are up to h/6 off the grid."""
    mesh = wf.Mesh.rectangle((1, 1), (n, n)) if dim == 2 else wf.Mesh.box((1, 1, 1), (n, n, n))
    if not perturbed:
        return mesh
    shift = np.random.default_rng(n).uniform(-1.0, 1.0, mesh.points.shape) / (6.0 * n)
    shift[mesh.boundary_points] = 0.0
    return wf.Mesh(mesh.points + shift, mesh.cells, mesh.point_sets)


def errors(material: HookeanMaterial, mesh: wf.Mesh, element: str) -> tuple[float, float]:
    """The errors of the solution in L2 [m] and in the H1 seminorm, relative to those of the manufactured one."""
    stress = partial(STRESSES[material.name], mu=float(material.mu), lam=float(material.lam))
    shape = body(mesh, material, element).mesh
    field = Field(shape)
    loads = field.loads(body_force(STRESSES[material.name], field.x, float(material.mu), float(material.lam)))
    x, weights, N, normals = boundary_quadrature(shape)
    P = stress(np.eye(shape.dim) + gradient(x))
    loads += boundary_loads(shape, np.einsum("fqij,fj->fqi", P, normals), weights, N)
    held = np.unique(np.concatenate([shape.point_sets[side] for side in HELD[shape.dim]]))
    loads[held] = 0.0

    def move(rest: np.ndarray, time: float) -> np.ndarray:
        return rest + displacement(rest)

    solid = body(mesh, material, element, supports=[wf.PrescribedMotion(held, move)], loads=point_forces(loads))
    u = solved(model_of(solid), start=displacement(shape.points)).displacement
    norms = []
    for found, exact in ((field.values(u), displacement(field.x)), (field.gradients(u), gradient(field.x))):
        axes = tuple(range(2, exact.ndim))
        difference, size = ((field.w * (v**2).sum(axis=axes)).sum() for v in (found - exact, exact))
        norms.append(float(np.sqrt(difference / size)))
    return norms[0], norms[1]


def run(quick: bool) -> Iterator[Check | Table]:
    for element in ELEMENTS:
        for dim in (2, 3):
            counts = {(2, True): (8, 16), (2, False): (8, 16, 32, 64), (3, True): (4, 8), (3, False): (4, 8, 16)}
            for name, material in MATERIALS.items():
                for perturbed in (False, True):
                    if quick and (perturbed or (name == "linear") != (dim == 2)):
                        continue
                    sizes = counts[dim, quick]
                    if element == "quadratic" and not quick:
                        sizes = sizes[:-1]
                    found = [errors(material(E=E, nu=NU), unit_mesh(dim, n, perturbed), element) for n in sizes]
                    where = f"{element}, {dim}D, {name}, {'perturbed' if perturbed else 'regular'} cells"
                    h = [1.0 / n for n in sizes]
                    observed = [orders(h, norm) for norm in zip(*found, strict=True)]
                    rows = [[f"1/{n}", *(f"{e:.3e}" for e in pair)] for n, pair in zip(sizes, found, strict=True)]
                    for row, *pair in zip(rows[1:], *observed, strict=True):
                        row[2:2], row[4:] = [f"{pair[0]:.2f}"], [f"{pair[1]:.2f}"]
                    rows[0] = [rows[0][0], rows[0][1], "", rows[0][2], ""]
                    yield Table(f"Relative errors, {where}", ["h", "L2", "order", "H1", "order"], rows)
                    for norm, expected, order in zip(("L2", "H1"), ORDERS[element], observed, strict=True):
                        yield between(f"order in {norm}, {where}", order[-1], expected - 0.1, expected + 0.1)


CASE = Case(
    name="manufactured",
    title="Manufactured solutions",
    what=(
        "The unit square and cube under the body force and the tractions that make u_i = 0.1 sin(k_i . X + phi_i) the "
        "solution, u prescribed on all sides but the right one; E = 1, nu = 0.3. Loads and errors by Gauss quadrature "
        "of degree 7. Newton's method starts at the interpolated solution."
    ),
    reference=(
        "the manufactured solution itself (Roache 2002, Code verification by the method of manufactured solutions); "
        "the body force is -Div P by complex steps of P in NumPy."
    ),
    criterion=(
        "the order between the two finest meshes is 2 in L2 and 1 in H1 for linear cells, 3 and 2 for quadratic ones, "
        "within 0.1."
    ),
    run=run,
)
