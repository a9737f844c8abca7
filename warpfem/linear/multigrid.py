"""Smoothed-aggregation multigrid with rigid-body modes (Vanek, Mandel and Brezina 1996), as a preconditioner.

The hierarchy is that of the package ``pyamg``: every point joins an aggregate, on which the coarse unknowns are the
rigid modes that the aggregate's points can follow; the prolongation is smoothed by a Jacobi step, and the coarse
matrices are P^T A P. The cycle is of our own kernels in float32, which a preconditioner can afford: Chebyshev
polynomials of D^-1 A smooth (Adams et al. 2003), with D the diagonal blocks, before and after the coarse correction;
the inverse of the coarsest matrix is dense.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from warpfem.linear.conjugate_gradients import RenewedPreconditioner
from warpfem.linear.operators import AssembledOperator, add_row_product

DEGREE = 2
"""Of the Chebyshev polynomials, each of which takes as many products."""

LOWEST = 0.1
"""Part of the largest eigenvalue of D^-1 A from which on smoothing damps."""

COARSEST = 100
"""Aggregates of which the inverse is dense."""


class Multigrid(RenewedPreconditioner):
    """A V-cycle for A as it was when :meth:`update` was called last."""

    def __init__(self, operator: AssembledOperator) -> None:
        self._operator = operator
        self._levels: list[_Level] = []

    def update(self) -> bool:
        """Builds the hierarchy of A as it is now; returns whether A seems to be positive definite."""
        from pyamg import smoothed_aggregation_solver

        model = self._operator.model
        matrix = assembled_matrix(self._operator)
        if not np.isfinite(matrix.data).all():
            return False
        hierarchy = smoothed_aggregation_solver(
            matrix,
            B=rigid_modes(self._operator),
            strength=("symmetric", {"theta": 0.0}),
            improve_candidates=None,
            max_coarse=COARSEST,
            coarse_solver=None,
        )
        self._levels = [_Level(level, model.device) for level in hierarchy.levels]
        self._coarsest = _Coarsest(self._levels[-1], hierarchy.levels[-1].A, model.device)
        self._copy = _copy_kernels(model.dim, model.dtype)
        self.version += 1
        return self._coarsest.definite and all(level.definite for level in self._levels)

    def apply(self, r: wp.array, z_out: wp.array) -> None:
        finest = self._levels[0]
        wp.launch(self._copy.to_single, r.shape[0], inputs=[r], outputs=[finest.b], device=r.device)
        self._cycle(0)
        wp.launch(self._copy.from_single, r.shape[0], inputs=[finest.x], outputs=[z_out], device=r.device)

    def _cycle(self, index: int) -> None:
        level = self._levels[index]
        if index == len(self._levels) - 1:
            self._coarsest.solve(level)
            return
        coarse = self._levels[index + 1]
        level.smooth_from_zero()
        level.restrict(coarse)
        self._cycle(index + 1)
        level.prolong(coarse)
        level.smooth()

    def arrays(self) -> list[wp.array]:
        return [array for level in self._levels for array in level.arrays()]


def assembled_matrix(operator: AssembledOperator):
    """A as a SciPy block matrix in float64, with the couplings of averaged cells."""
    from scipy.sparse import bsr_matrix, csr_matrix

    model, pattern = operator.model, operator.assembly.pattern
    d, size = model.dim, model.dim * model.point_count
    blocks = operator.assembly.blocks.numpy().astype(np.float64)
    matrix = bsr_matrix((blocks, pattern.columns, pattern.row_starts), shape=(size, size))
    free = operator.free.numpy().ravel().astype(np.float64)
    for block in operator.averaged:
        starts, points, rows, inverse = block.coupling_rows()
        columns = (points[:, None] * d + np.arange(d)).ravel()
        entries = rows.ravel().astype(np.float64) * (free[columns] if len(free) else 1.0)
        R = csr_matrix((entries, columns, starts * d), shape=(len(inverse), size))
        matrix = matrix + (R.T @ R.multiply(inverse[:, None])).tobsr((d, d))
    return matrix.tobsr((d, d))


def rigid_modes(operator: AssembledOperator) -> np.ndarray:
    """Translations and rotations of all points, zero where held, (unknowns, 3 in 2D or 6 in 3D)."""
    model = operator.model
    x = model.rest_points - model.rest_points.mean(axis=0)
    x = x / np.abs(x).max()
    n, d = x.shape
    planes = [(i, j) for i in range(d) for j in range(i + 1, d)]
    modes = np.zeros((n, d, d + len(planes)))
    modes[:, range(d), range(d)] = 1.0
    for k, (i, j) in enumerate(planes):
        modes[:, i, d + k], modes[:, j, d + k] = -x[:, j], x[:, i]
    free = operator.free.numpy()
    if len(free):
        modes *= free[:, :, None]
    return modes.reshape(n * d, -1)


class _Level:
    """A level of the hierarchy, and its part of the cycle.

    Attributes:
        b: right-hand side.
        x: solution.
        size: rows of blocks.
        definite: whether its diagonal blocks are positive definite.
    """

    def __init__(self, level, device) -> None:
        A = level.A
        self.device = device
        self.block = A.blocksize[0]
        self.size = A.shape[0] // self.block
        self.kernels = _level_kernels(self.block)
        self._A = _device_matrix(A, device)
        inverse, self.definite = _inverse(_diagonal_blocks(A))
        largest = 1.1 * _largest_eigenvalue(A, inverse)
        self._inverse = wp.array(inverse.astype(np.float32), dtype=_matrix(self.block, self.block), device=device)
        self.b, self.x, self._r, self._d, self._e = (
            wp.zeros(self.size, dtype=_vector(self.block), device=device) for _ in range(5)
        )
        # the recurrence of Chebyshev polynomials on [LOWEST, 1] of the largest eigenvalue (Saad 2003, algorithm 12.1)
        center, half = 0.5 * (1.0 + LOWEST) * largest, 0.5 * (1.0 - LOWEST) * largest
        self._first = 1.0 / center
        self._factors, ratio = [], half / center
        for _ in range(DEGREE):
            following = 1.0 / (2.0 * center / half - ratio)
            self._factors.append((following * ratio, 2.0 * following / half))
            ratio = following
        self._transfers = None
        if hasattr(level, "P"):
            P = level.P.tobsr()
            kernels = _transfer_kernels(*P.blocksize)
            self._transfers = kernels, _device_matrix(P, device), _device_matrix(P.T.tobsr(P.blocksize[::-1]), device)

    def smooth_from_zero(self) -> None:
        """Leaves x, and the residual."""
        self._launch("begin", [self.b, self._inverse, self._first], [self.x, self._r, self._d])
        for factors in self._factors:
            self._step(factors)

    def smooth(self) -> None:
        """Improves x."""
        self._launch("resume", [*self._A, self.b, self.x, self._inverse, self._first], [self._r, self._d])
        for factors in self._factors[:-1]:
            self._step(factors)
        self._launch("add", [self._d], [self.x])

    def _step(self, factors: tuple[float, float]) -> None:
        self._launch("step", [*self._A, self._inverse, *factors, self._d], [self.x, self._r, self._e])
        self._d, self._e = self._e, self._d

    def restrict(self, coarse: "_Level") -> None:
        """Writes the coarse level's right-hand side."""
        kernels, _, R = self._transfers
        wp.launch(kernels.restrict, coarse.size, inputs=[*R, self._r], outputs=[coarse.b], device=self.device)

    def prolong(self, coarse: "_Level") -> None:
        """Adds the coarse level's solution."""
        kernels, P, _ = self._transfers
        wp.launch(kernels.prolong, self.size, inputs=[*P, coarse.x], outputs=[self.x], device=self.device)

    def arrays(self) -> list[wp.array]:
        own = [*self._A, self._inverse, self.b, self.x, self._r, self._d, self._e]
        return own if self._transfers is None else [*own, *self._transfers[1], *self._transfers[2]]

    def _launch(self, name: str, inputs: list, outputs: list) -> None:
        wp.launch(getattr(self.kernels, name), self.size, inputs=inputs, outputs=outputs, device=self.device)


class _Coarsest:
    """The dense inverse of the coarsest matrix."""

    def __init__(self, level: _Level, matrix, device) -> None:
        inverse, self.definite = _inverse(matrix.toarray())
        m = level.block
        blocks = inverse.reshape(level.size, m, level.size, m).transpose(0, 2, 1, 3)
        self._inverse = wp.array(np.ascontiguousarray(blocks, dtype=np.float32), dtype=_matrix(m, m), device=device)

    def solve(self, level: _Level) -> None:
        level._launch("multiply_dense", [self._inverse, level.b], [level.x])


def _inverse(matrices: np.ndarray) -> tuple[np.ndarray, bool]:
    """That of symmetric matrices (..., m, m), and whether all are positive definite.

    Aggregates of which points are held can lack some of the modes: these have rows of zeros, and get no motion.
    """
    m = matrices.shape[-1]
    diagonal = matrices[..., range(m), range(m)]
    least = 1e-12 * np.abs(diagonal).max(axis=-1, keepdims=True)
    absent = np.abs(diagonal) <= least
    matrices = matrices.copy()
    matrices[..., range(m), range(m)] = np.where(absent, 1.0, diagonal)
    try:
        np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        return matrices, False
    inverse = np.linalg.inv(matrices)
    inverse[..., range(m), range(m)] -= absent
    return inverse, True


def _diagonal_blocks(A) -> np.ndarray:
    rows = np.repeat(np.arange(len(A.indptr) - 1), np.diff(A.indptr))
    on_diagonal = A.indices == rows
    blocks = np.zeros((len(A.indptr) - 1, *A.blocksize))
    blocks[rows[on_diagonal]] = A.data[on_diagonal]
    return blocks


def _largest_eigenvalue(A, inverse: np.ndarray) -> float:
    """Of D^-1 A, by power iteration."""
    m = A.blocksize[0]
    x = np.random.default_rng(0).standard_normal(A.shape[0])
    for _ in range(15):
        x /= np.linalg.norm(x)
        x = np.einsum("nij,nj->ni", inverse, (A @ x).reshape(-1, m)).ravel()
    return float(np.linalg.norm(x))


def _device_matrix(A, device) -> tuple[wp.array, wp.array, wp.array]:
    """Row starts, columns and blocks of a SciPy block matrix."""
    starts, columns = (wp.array(data, dtype=wp.int32, device=device) for data in (A.indptr, A.indices))
    return starts, columns, wp.array(A.data.astype(np.float32), dtype=_matrix(*A.blocksize), device=device)


def _vector(length: int) -> type:
    return wp.types.vector(length=length, dtype=wp.float32)


def _matrix(rows: int, columns: int) -> type:
    return wp.types.matrix(shape=(rows, columns), dtype=wp.float32)


@functools.cache
def _copy_kernels(dim: int, dtype: str) -> SimpleNamespace:
    scalar = {"float32": wp.float32, "float64": wp.float64}[dtype]
    vector, single = wp.types.vector(length=dim, dtype=scalar), _vector(dim)
    module = f"warpfem.multigrid_copy_{dim}_{dtype}"

    @wp.kernel(module=module, enable_backward=False)
    def to_single(a: wp.array(dtype=vector), single_out: wp.array(dtype=single)):
        i = wp.tid()
        result = single()
        for k in range(dim):
            result[k] = wp.float32(a[i][k])
        single_out[i] = result

    @wp.kernel(module=module, enable_backward=False)
    def from_single(a: wp.array(dtype=single), vector_out: wp.array(dtype=vector)):
        i = wp.tid()
        result = vector()
        for k in range(dim):
            result[k] = scalar(a[i][k])
        vector_out[i] = result

    return SimpleNamespace(to_single=to_single, from_single=from_single)


@functools.cache
def _level_kernels(block: int) -> SimpleNamespace:
    """The kernels of levels with blocks of that size."""
    vector, matrix = _vector(block), _matrix(block, block)
    module = f"warpfem.multigrid_{block}"

    @wp.kernel(module=module, enable_backward=False)
    def begin(
        b: wp.array(dtype=vector),
        inverse: wp.array(dtype=matrix),
        factor: wp.float32,
        x_out: wp.array(dtype=vector),
        r_out: wp.array(dtype=vector),
        d_out: wp.array(dtype=vector),
    ):
        """For x = 0: r = b, d = factor D^-1 r."""
        i = wp.tid()
        x_out[i] = vector()
        r_out[i] = b[i]
        d_out[i] = factor * (inverse[i] * b[i])

    @wp.kernel(module=module, enable_backward=False)
    def resume(
        row_starts: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        blocks: wp.array(dtype=matrix),
        b: wp.array(dtype=vector),
        x: wp.array(dtype=vector),
        inverse: wp.array(dtype=matrix),
        factor: wp.float32,
        r_out: wp.array(dtype=vector),
        d_out: wp.array(dtype=vector),
    ):
        """r = b - A x, d = factor D^-1 r."""
        i = wp.tid()
        r = b[i] - add_row_product(row_starts, columns, blocks, x, i, vector())
        r_out[i] = r
        d_out[i] = factor * (inverse[i] * r)

    @wp.kernel(module=module, enable_backward=False)
    def step(
        row_starts: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        blocks: wp.array(dtype=matrix),
        inverse: wp.array(dtype=matrix),
        keep: wp.float32,
        factor: wp.float32,
        d: wp.array(dtype=vector),
        x_out: wp.array(dtype=vector),
        r_out: wp.array(dtype=vector),
        d_out: wp.array(dtype=vector),
    ):
        """x += d, r -= A d, then d = keep d + factor D^-1 r."""
        i = wp.tid()
        x_out[i] += d[i]
        r = r_out[i] - add_row_product(row_starts, columns, blocks, d, i, vector())
        r_out[i] = r
        d_out[i] = keep * d[i] + factor * (inverse[i] * r)

    @wp.kernel(module=module, enable_backward=False)
    def add(d: wp.array(dtype=vector), x_out: wp.array(dtype=vector)):
        """x += d."""
        i = wp.tid()
        x_out[i] += d[i]

    @wp.kernel(module=module, enable_backward=False)
    def multiply_dense(inverse: wp.array2d(dtype=matrix), b: wp.array(dtype=vector), x_out: wp.array(dtype=vector)):
        """Writes the product of a dense matrix of blocks with b."""
        i = wp.tid()
        total = vector()
        for j in range(b.shape[0]):
            total += inverse[i, j] * b[j]
        x_out[i] = total

    return SimpleNamespace(**{name: kernel for name, kernel in locals().items() if isinstance(kernel, wp.Kernel)})


@functools.cache
def _transfer_kernels(fine: int, coarse: int) -> SimpleNamespace:
    """The kernels between levels with blocks of those sizes."""
    fine_vector, coarse_vector = _vector(fine), _vector(coarse)
    down, up = _matrix(coarse, fine), _matrix(fine, coarse)
    module = f"warpfem.multigrid_{fine}_{coarse}"

    @wp.kernel(module=module, enable_backward=False)
    def restrict(
        row_starts: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        blocks: wp.array(dtype=down),
        r: wp.array(dtype=fine_vector),
        b_out: wp.array(dtype=coarse_vector),
    ):
        """Writes P^T r."""
        i = wp.tid()
        b_out[i] = add_row_product(row_starts, columns, blocks, r, i, coarse_vector())

    @wp.kernel(module=module, enable_backward=False)
    def prolong(
        row_starts: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        blocks: wp.array(dtype=up),
        x: wp.array(dtype=coarse_vector),
        x_out: wp.array(dtype=fine_vector),
    ):
        """Adds P x."""
        i = wp.tid()
        x_out[i] += add_row_product(row_starts, columns, blocks, x, i, fine_vector())

    return SimpleNamespace(restrict=restrict, prolong=prolong)
