"""An independent high-order solver: spectral elements on a mapped grid of squares or cubes, in NumPy and SciPy.

Lagrange polynomials on Gauss-Lobatto-Legendre points (Karniadakis and Sherwin 2005), integrated by Gauss quadrature
with two points more than the degree. Grids graded towards corners resolve the singularities there, so that the error
falls exponentially. Nothing of it is shared with warpfem.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from numpy.polynomial import legendre
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu

from verification.hyperelastic import Stress, tangent


@cache
def lobatto_points(p: int) -> np.ndarray:
    """The p + 1 Gauss-Lobatto-Legendre points in [-1, 1]: the ends and the extremes of Legendre's P_p."""
    return np.concatenate([[-1.0], np.sort(legendre.Legendre.basis(p).deriv().roots().real), [1.0]])


def lagrange(nodes: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values and derivatives (len(x), len(nodes)) of the Lagrange polynomials on nodes."""
    V = legendre.legvander(nodes, len(nodes) - 1)
    at = legendre.legvander(x, len(nodes) - 1)
    rates = np.stack([legendre.legval(x, legendre.legder(row)) for row in np.eye(len(nodes))], axis=1)
    return np.linalg.solve(V.T, at.T).T, np.linalg.solve(V.T, rates.T).T


def graded(levels: int, ends: str = "both", ratio: float = 0.15) -> np.ndarray:
    """Divisions of [0, 1] whose lengths fall geometrically towards an end, "left", or towards "both"."""
    toward = np.concatenate([[0.0], ratio ** np.arange(levels - 1, -1, -1.0)])
    return toward if ends == "left" else np.concatenate([0.5 * toward, 1.0 - 0.5 * toward[-2::-1]])


class Grid:
    """Spectral elements on the image of the unit square or cube.

    Attributes:
        points: (n, d) places of the unknowns.
        reference: (n, d) their places in the unit square or cube.
    """

    def __init__(
        self,
        divisions: Sequence[np.ndarray],
        p: int,
        place: Callable[[np.ndarray], np.ndarray],
        jacobian: Callable[[np.ndarray], np.ndarray],
    ) -> None:
        self.dim = d = len(divisions)
        nodes, (gauss, weights) = lobatto_points(p), legendre.leggauss(p + 2)
        N1, D1 = lagrange(nodes, gauss)
        ticks = [
            np.append((a[:-1, None] + 0.5 * (nodes[None, :-1] + 1.0) * np.diff(a)[:, None]).ravel(), a[-1])
            for a in divisions
        ]
        self.reference = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, d)
        self.points = place(self.reference)
        numbers = np.arange(len(self.reference)).reshape([len(t) for t in ticks])
        starts = np.stack(np.meshgrid(*[np.arange(len(a) - 1) for a in divisions], indexing="ij"), -1).reshape(-1, d)
        windows = [starts[:, k, None] * p + np.arange(p + 1) for k in range(d)]
        shape = [[-1, *(p + 1 if i == k else 1 for i in range(d))] for k in range(d)]
        self.elements = numbers[tuple(w.reshape(s) for w, s in zip(windows, shape, strict=True))].reshape(
            len(starts), -1
        )
        # shape functions and rates on the reference element, as products over the axes
        self.N = _product([N1] * d)
        rates = np.stack([_product([D1 if i == k else N1 for i in range(d)]) for k in range(d)], axis=-1)
        w = _product([weights[:, None]] * d)[:, 0]
        half = 0.5 * np.stack([np.diff(a)[starts[:, k]] for k, a in enumerate(divisions)], axis=1)
        low = np.stack([a[starts[:, k]] for k, a in enumerate(divisions)], axis=1)
        local = np.stack([g.ravel() for g in np.meshgrid(*[gauss] * d, indexing="ij")], axis=1)
        self.at = low[:, None] + (local + 1.0) * half[:, None]  # quadrature points in the unit cube
        J = jacobian(self.at)
        self.weights = np.linalg.det(J) * w * half.prod(axis=1)[:, None]
        # grad N = dN/dxi / half * J^-1
        self.gradients = np.einsum("qak,ek,eqkj->eqaj", rates, 1.0 / half, np.linalg.inv(J), optimize=True)
        self._p, self._divisions, self._numbers = p, divisions, numbers

    @property
    def size(self) -> int:
        """How many unknowns there are, held ones included."""
        return len(self.points) * self.dim

    def side(self, axis: int, end: int) -> np.ndarray:
        """The points on a side: ``end`` 0 or -1 of an axis."""
        return self._numbers.take(end, axis=axis).ravel()

    def side_load(self, axis: int, end: int, force: Sequence[float]) -> np.ndarray:
        """The loads (n, d) of a total force spread evenly over a side of a grid whose sides are flat."""
        loads = np.zeros((len(self.points), self.dim))
        others = [k for k in range(self.dim) if k != axis]
        weights = [_trace_weights(self._divisions[k], self._p) for k in others]
        spread = weights[0] if len(weights) == 1 else np.outer(*weights).ravel()
        loads[self.side(axis, end)] = spread[:, None] * np.asarray(force)
        return loads

    def body_load(self, density: Sequence[float]) -> np.ndarray:
        """The loads (n, d) of a constant force per volume."""
        own = np.einsum("eq,qa->ea", self.weights, self.N)
        total = np.zeros(len(self.points))
        np.add.at(total, self.elements, own)
        return total[:, None] * np.asarray(density)

    def force_and_stiffness(self, u: np.ndarray, stress: Stress, mu: float, lam: float) -> tuple[np.ndarray, csc_array]:
        """The internal forces dU/du (n, d) and their tangent."""
        d = self.dim
        force = np.zeros((len(self.points), d))
        rows, columns, values = [], [], []
        stress = np.errstate(invalid="ignore")(stress)
        for element, G, w in zip(self.elements, self.gradients, self.weights, strict=True):
            F = np.eye(d) + np.einsum("qaj,ai->qij", G, u[element])
            P = stress(F, mu, lam)
            force[element] += np.einsum("q,qij,qaj->ai", w, P, G, optimize=True)
            A = tangent(stress, F, mu, lam) * w[:, None, None, None, None]
            n = len(element)
            right = np.einsum("qijkl,qbl->qjibk", A, G, optimize=True).reshape(-1, d * n * d)
            K = G.transpose(0, 2, 1).reshape(-1, n).T @ right
            numbers = (element[:, None] * d + np.arange(d)).ravel()
            rows.append(np.repeat(numbers, n * d))
            columns.append(np.tile(numbers, n * d))
            values.append(K.reshape(n, d, n, d).ravel())
        parts = (np.concatenate(part) for part in (values, rows, columns))
        data, i, j = parts
        return force, coo_array((data, (i, j)), shape=(self.size, self.size)).tocsc()

    def solve(
        self, stress: Stress, mu: float, lam: float, held: np.ndarray, load: np.ndarray, steps: int = 1
    ) -> np.ndarray:
        """The static displacements (n, d): Newton's method, the load in equal steps.

        Args:
            stress: the material.
            mu, lam: Lamé's parameters.
            held: mask (n, d) of components that stay at 0.
            load: forces (n, d).
            steps: of the load.
        """
        free = np.flatnonzero(~held.ravel())
        u = np.zeros((len(self.points), self.dim))
        force, K = self.force_and_stiffness(u, stress, mu, lam)
        for step in range(1, steps + 1):
            target = load * (step / steps)
            for _ in range(30):
                residual = (target - force).ravel()[free]
                if np.abs(residual).max() <= 1e-11 * np.abs(target).max():
                    break
                factors = splu(K[free][:, free], permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
                change = np.zeros(self.size)
                change[free] = factors.solve(residual)
                change = change.reshape(u.shape)
                force, K = self.force_and_stiffness(u + change, stress, mu, lam)
                while not np.isfinite(force).all():  # J <= 0 somewhere
                    change *= 0.5
                    force, K = self.force_and_stiffness(u + change, stress, mu, lam)
                u += change
                if np.abs(change).max() <= 1e-9 * np.abs(u).max():
                    break
            else:
                raise RuntimeError(f"Newton's method does not converge at load step {step} of {steps}")
        return u

    def value(self, u: np.ndarray, where: Sequence[float]) -> np.ndarray:
        """The displacement (d,) at a place of the unit square or cube."""
        element, basis = 0, np.ones(1)
        for k, x in enumerate(where):
            a = self._divisions[k]
            cell = min(int(np.searchsorted(a, x, side="right")) - 1, len(a) - 2)
            local = 2.0 * (x - a[cell]) / (a[cell + 1] - a[cell]) - 1.0
            basis = np.outer(basis, lagrange(lobatto_points(self._p), np.array([local]))[0][0]).ravel()
            element = element * (len(a) - 1) + cell
        return basis @ u[self.elements[element]]


def box(size: Sequence[float], divisions: Sequence[np.ndarray], p: int) -> Grid:
    """A grid on a rectangle or box with a corner at the origin."""
    lengths = np.asarray(size, dtype=float)
    return Grid(divisions, p, lambda x: x * lengths, lambda x: np.broadcast_to(np.diag(lengths), (*x.shape, len(size))))


def quadrilateral(corners: Sequence[Sequence[float]], divisions: Sequence[np.ndarray], p: int) -> Grid:
    """A grid on the bilinear image of the unit square: its corners (0,0), (1,0), (1,1), (0,1)."""
    c = np.asarray(corners, dtype=float)

    def place(x: np.ndarray) -> np.ndarray:
        s, t = x[..., :1], x[..., 1:]
        return (1 - s) * (1 - t) * c[0] + s * (1 - t) * c[1] + s * t * c[2] + (1 - s) * t * c[3]

    def jacobian(x: np.ndarray) -> np.ndarray:
        s, t = x[..., :1], x[..., 1:]
        return np.stack([(1 - t) * (c[1] - c[0]) + t * (c[2] - c[3]), (1 - s) * (c[3] - c[0]) + s * (c[2] - c[1])], -1)

    return Grid(divisions, p, place, jacobian)


def _product(factors: list[np.ndarray]) -> np.ndarray:
    result = factors[0]
    for factor in factors[1:]:
        result = np.einsum("qa,rb->qrab", result, factor).reshape(len(result) * len(factor), -1)
    return result


def _trace_weights(division: np.ndarray, p: int) -> np.ndarray:
    """The integrals over [0, 1] of the basis functions along an axis."""
    gauss, weights = legendre.leggauss(p + 2)
    own = weights @ lagrange(lobatto_points(p), gauss)[0]
    total = np.zeros((len(division) - 1) * p + 1)
    for cell, length in enumerate(np.diff(division)):
        total[cell * p : cell * p + p + 1] += 0.5 * length * own
    return total
