"""The exact discrete answers of another finite element code on meshes given by a formula."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import skfem
from scipy.sparse.linalg import spsolve
from skfem.helpers import dot, grad

import warpfem as wf
from verification.core import Case, Check, at_most
from verification.hyperelastic import STRESSES, lame, tangent
from verification.models import SEPARATE_ELEMENTS, body, mapped, model_of, solved
from verification.simplex import order_of
from warpfem.materials import HookeanMaterial

E, NU, DENSITY = 2.0, 0.35, 1.0
GRAVITY = {2: (0.02, -0.05), 3: (0.02, -0.05, 0.03)}
TRACTION = {2: (0.1, 0.05), 3: (0.1, 0.05, -0.08)}
ELEMENT_TYPES = {
    (2, 1): skfem.ElementTriP1,
    (2, 2): skfem.ElementTriP2,
    (3, 1): skfem.ElementTetP1,
    (3, 2): skfem.ElementTetP2,
}


def bent(x: np.ndarray) -> np.ndarray:
    """Where the points of the unit square or cube go, so that no two cells are congruent."""
    return x + 0.05 * np.sin(3.0 * np.roll(x, 1, axis=1) + np.arange(1, x.shape[1] + 1))


def mesh_of(dim: int, n: int) -> wf.Mesh:
    """A bent square or cube of n squares or cubes along each side."""
    return mapped(wf.Mesh.rectangle((1, 1), (n, n)) if dim == 2 else wf.Mesh.box((1, 1, 1), (n, n, n)), bent)


def ours(mesh: wf.Mesh, material: HookeanMaterial, element: str) -> np.ndarray:
    """The static displacements (n, dim) by warpfem."""
    supports, loads = [wf.Pin("left")], [wf.Traction("right", TRACTION[mesh.dim])]
    solid = body(mesh, material, element, density=DENSITY, supports=supports, loads=loads)
    return solved(model_of(solid, gravity=GRAVITY[mesh.dim]), tolerance=1e-12).displacement


def theirs(mesh: wf.Mesh, material: HookeanMaterial) -> np.ndarray:
    """The same by scikit-fem: its mesh, elements, quadrature and assembly, and Newton's method with SciPy's solver."""
    dim = mesh.dim
    stress, moduli = STRESSES[material.name], lame(E, NU)
    corners = np.unique(mesh.cells[:, : dim + 1])
    number = np.full(mesh.point_count, -1)
    number[corners] = np.arange(len(corners))
    kind = skfem.MeshTri if dim == 2 else skfem.MeshTet
    own = kind(mesh.points[corners].T.copy(), number[mesh.cells[:, : dim + 1]].T.copy())
    element = skfem.ElementVector(ELEMENT_TYPES[dim, order_of(mesh)]())
    basis = skfem.Basis(own, element, intorder=2)

    def side(name: str) -> np.ndarray:
        chosen = np.isin(np.arange(len(corners)), number[np.intersect1d(mesh.point_sets[name], corners)])
        return np.intersect1d(np.flatnonzero(chosen[own.facets].all(axis=0)), own.boundary_facets())

    @skfem.LinearForm
    def internal(v, w):
        return np.einsum("ijcq,ijcq->cq", P, grad(v))

    @skfem.BilinearForm
    def stiffness(u, v, w):
        return np.einsum("ijcq,ijcq->cq", np.einsum("ijklcq,klcq->ijcq", A, grad(u)), grad(v))

    @skfem.LinearForm
    def weight(v, w):
        return DENSITY * dot(np.array(GRAVITY[dim])[:, None, None], v)

    @skfem.LinearForm
    def traction(v, w):
        return dot(np.array(TRACTION[dim])[:, None, None], v)

    loads = weight.assemble(basis) + traction.assemble(skfem.FacetBasis(own, element, facets=side("right"), intorder=2))
    held = basis.get_dofs(side("left")).all()
    u = basis.zeros()
    for _ in range(20):
        F = np.eye(dim) + np.moveaxis(grad(basis.interpolate(u)), (0, 1), (-2, -1))  # (cells, points, d, d)
        P = np.moveaxis(stress(F, *moduli), (-2, -1), (0, 1))
        A = np.moveaxis(tangent(stress, F, *moduli), (2, 3, 4, 5), (0, 1, 2, 3))
        K, f = stiffness.assemble(basis), loads - internal.assemble(basis)
        change = skfem.solve(*skfem.condense(K, f, D=held), solver=lambda A, b: spsolve(A.tocsc(), b))
        u += change
        if np.abs(change).max() < 1e-13 * np.abs(u).max():
            break
    return _at_points(basis, u, mesh.points)


def _at_points(basis: skfem.Basis, u: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The displacements (n, dim) of scikit-fem's unknowns at warpfem's points, by their places."""
    places, dim = basis.doflocs.T, points.shape[1]
    component = np.empty(len(places), dtype=int)
    for numbers in (basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs):
        for k in range(len(numbers)):
            component[numbers[k]] = k
    result = np.empty(points.shape)
    for k in range(dim):
        own = np.flatnonzero(component == k)
        keys = [np.lexsort(np.round(x, 9).T) for x in (places[own], points)]
        result[keys[1], k] = u[own[keys[0]]]
    return result


def run(quick: bool) -> Iterator[Check]:
    for element in SEPARATE_ELEMENTS:
        for dim in (2, 3):
            for material in (wf.LinearElasticity(E=E, nu=NU), wf.NeoHookean(E=E, nu=NU)):
                if quick and (material.name == "linear") != (dim == 2):
                    continue
                n = {2: 6, 3: 3}[dim] if quick else {2: 12, 3: 4}[dim]
                mesh = mesh_of(dim, n if element == "quadratic" or quick else 2 * n)
                found = ours(mesh, material, element)
                expected = theirs(body(mesh, material, element).mesh, material)
                error = float(np.abs(found - expected).max() / np.abs(expected).max())
                yield at_most(f"{element}, {dim}D, {material.name}, {mesh.cell_count} cells", error, 1e-9)


CASE = Case(
    name="other_codes",
    title="The discrete solution of another code",
    what=(
        "A unit square and cube whose points go to x + 0.05 sin(3 x' + k), x' the next coordinate and k = 1, 2, 3 the "
        "number of the axis, clamped on the left, under gravity and a dead traction on the right; E = 2, nu = 0.35."
    ),
    reference=(
        "scikit-fem (Gustafsson and McBain 2020, JOSS 5, 2369): its spaces, quadrature and assembly on the same cells, "
        "with P in NumPy, its tangent by complex steps, and SciPy's direct solver."
    ),
    criterion="all displacements agree to 1e-9 of the largest.",
    run=run,
)
