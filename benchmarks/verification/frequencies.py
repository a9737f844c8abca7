"""Natural frequencies of free blocks."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import eigh
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import eigsh

import warpfem as wf
from verification.core import Case, Check, Table, at_most, between, orders
from verification.hyperelastic import lame
from verification.models import SEPARATE_ELEMENTS, body, model_of
from warpfem.model import Model

E, NU, DENSITY = 1.0, 0.3, 1.0
SIZES = {2: (1.0, 0.7), 3: (1.0, 0.8, 0.6)}
MODES = 5


def ritz_frequencies(size: tuple[float, ...], degree: int, count: int) -> np.ndarray:
    """The lowest angular frequencies [1/s] of a free block, rigid motions left out.

    Ritz's method with products of Legendre polynomials of a total degree (Visscher et al. 1991, J. Acoust. Soc. Am.
    90, 2154, who take powers).
    """
    dim = len(size)
    mu, lam = lame(E, NU)
    x, w = legendre.leggauss(degree + 1)
    scale = np.sqrt(np.arange(degree + 1) + 0.5)
    L = legendre.legvander(x, degree) * scale
    D = np.stack([legendre.legval(x, legendre.legder(row)) for row in np.eye(degree + 1)], axis=1) * scale
    gram = {(0, 0): L.T @ (w[:, None] * L), (1, 0): D.T @ (w[:, None] * L), (0, 1): L.T @ (w[:, None] * D)}
    gram[1, 1] = D.T @ (w[:, None] * D)
    powers = np.array([n for n in product(range(degree + 1), repeat=dim) if sum(n) <= degree])

    def integral(j: int, m: int) -> np.ndarray:
        """Integrals of d_j phi_a d_m phi_b over the block, over those of phi_a^2."""
        result = np.full((len(powers), len(powers)), 4.0 / (size[j] * size[m]))
        for axis in range(dim):
            result *= gram[int(axis == j), int(axis == m)][powers[:, None, axis], powers[None, :, axis]]
        return result

    parts = {(j, m): integral(j, m) for j in range(dim) for m in range(dim)}
    trace = sum(parts[j, j] for j in range(dim))
    K = [
        [lam * parts[i, k] + mu * parts[k, i] + (mu * trace if i == k else 0.0) for k in range(dim)] for i in range(dim)
    ]
    values = eigh(np.block(K) / DENSITY, eigvals_only=True)
    rigid = 3 if dim == 2 else 6
    return np.sqrt(values[rigid : rigid + count])


def frequencies(model: Model, count: int) -> np.ndarray:
    """The same by warpfem's stiffness and lumped mass."""
    d = model.dim
    rows, columns, values = [], [], []
    for block, stiffness in zip(model.blocks, model.element_stiffness(), strict=True):
        numbers = (block.host_cells[..., None] * d + np.arange(d)).reshape(len(block.host_cells), -1)
        n = numbers.shape[1]
        rows.append(np.repeat(numbers, n, axis=1).ravel())
        columns.append(np.tile(numbers, (1, n)).ravel())
        values.append(stiffness.reshape(-1))
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    K = coo_array(entries, shape=(model.point_count * d,) * 2).tocsc()
    root = diags_array(np.repeat(model.lumped_mass, d) ** -0.5)
    rigid = 3 if d == 2 else 6
    start = np.random.default_rng(1).normal(size=K.shape[0])
    found = eigsh((root @ K @ root).tocsc(), rigid + count, sigma=-0.01, v0=start, return_eigenvectors=False)
    return np.sqrt(np.sort(found)[rigid:])


def block(dim: int, n: int) -> wf.Mesh:
    """The block in n cubes along its longest side."""
    size = SIZES[dim]
    counts = [round(n * s) for s in size]
    return wf.Mesh.rectangle(size, counts) if dim == 2 else wf.Mesh.box(size, counts)


def run(quick: bool) -> Iterator[Check | Table]:
    mu, _ = lame(E, NU)
    for dim in (2,) if quick else (2, 3):
        # a free square or cube has Lame's mode u = (-cos kx sin ky, sin kx cos ky), k = pi/L, of pure shear
        lame_mode = np.sqrt(2.0 * mu / DENSITY) * np.pi
        own = ritz_frequencies((1.0,) * dim, 12, 12)
        what = f"Lame's mode of the {'square' if dim == 2 else 'cube'} by Ritz's method, {dim}D"
        yield at_most(what, float(np.abs(own / lame_mode - 1.0).min()), 1e-8)
        degree = 14 if dim == 3 else 20
        exact, coarser = (ritz_frequencies(SIZES[dim], p, MODES) for p in (degree, degree - 2))
        change = float(np.abs(coarser / exact - 1.0).max())
        yield at_most(f"what the last two degrees change in the reference, {dim}D", change, 2e-5)
        for element in SEPARATE_ELEMENTS:
            sizes = (10, 20) if quick else (10, 20, 40, 80) if dim == 2 else (5, 10, 20)
            if element == "quadratic" and not quick:
                sizes = sizes[:-1]
            found = [
                frequencies(
                    model_of(body(block(dim, n), wf.LinearElasticity(E=E, nu=NU), element, density=DENSITY)), MODES
                )
                for n in sizes
            ]
            errors = np.array(found) / exact - 1.0
            head = ["h", *(f"mode {k + 1}: {w:.6f}" for k, w in enumerate(exact))]
            rows = [[f"1/{n}", *(f"{100 * e:+.3f} %" for e in row)] for n, row in zip(sizes, errors, strict=True)]
            yield Table(f"Relative errors of the angular frequencies, {element}, {dim}D", head, rows)
            order = orders([1.0 / n for n in sizes], np.abs(errors).max(axis=1).tolist())[-1]
            yield between(f"order of the largest error, {element}, {dim}D", order, 1.7, 4.3)
            extrapolated = float(np.abs(errors[-1] + (errors[-1] - errors[-2]) / 3.0).max())
            limit = 1e-3 if dim == 2 else 5e-3
            yield at_most(f"largest error extrapolated with order 2, {element}, {dim}D", extrapolated, limit)


CASE = Case(
    name="frequencies",
    title="Natural frequencies of a free block",
    what=(
        "The lowest five natural frequencies of a free block of 1 x 0.7 (x 1, plane strain) and of 1 x 0.8 x 0.6, E = "
        "1, nu = 0.3, density 1, from the stiffness at rest and the lumped mass."
    ),
    reference=(
        "Ritz's method with Legendre polynomials (after Visscher et al. 1991, J. Acoust. Soc. Am. 90, 2154), in NumPy; "
        "that is itself checked against Lame's mode of a free cube, omega = sqrt(2) pi c_s/L, in closed form."
    ),
    criterion=(
        "the reference is converged to 2e-5; the largest error falls with order 2 at least (1.7 to 4.3), and what "
        "extrapolation with order 2 leaves is at most 0.1 % in 2D and 0.5 % in 3D."
    ),
    run=run,
)
