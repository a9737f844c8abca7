"""L D L^T of assembled tangents by PARDISO of Intel's oneMKL (Schenk and Gärtner 2004), as a preconditioner.

The symbolic analysis is done once for a pattern. The couplings r_g r_g^T / L_g of averaged cells would fill the matrix
with patches of points; they are its Schur complement instead,

    [ K    R^T ]
    [ R    -L  ]   with a row r_g and an entry L_g for each patch g,

which is factored just as well, in any order of elimination (Vanderbei 1995). By the signs of D the factorisation tells
how many negative eigenvalues there are: as many as patches, or A is not positive definite (Sylvester's law of inertia).

The package ``pypardiso`` finds and loads the library. Its own interface analyses each matrix anew.
"""

import ctypes
import functools

import numpy as np
import warp as wp

from warpfem.errors import SimulationError
from warpfem.linear.conjugate_gradients import RenewedPreconditioner
from warpfem.linear.operators import AssembledOperator

_SYMMETRIC_INDEFINITE = -2
_REPRODUCIBLE = 2
_ANALYSE, _FACTORISE, _SOLVE, _RELEASE = 11, 22, 33, -1


class SparseFactor(RenewedPreconditioner):
    """The inverse of A as it was when :meth:`update` was called last."""

    on_device = False

    def __init__(self, operator: AssembledOperator) -> None:
        self._operator = operator
        self._matrix = _UpperTriangle(operator)
        self._pardiso = _Pardiso(self._matrix.row_starts, self._matrix.columns)

    def update(self, shift: float = 0.0) -> bool:
        """Factors A + shift D as it is now, D the diagonal blocks; returns whether that is positive definite."""
        return self._pardiso.factorise(self._matrix.values(shift)) == self._matrix.patch_count

    def apply(self, r: wp.array, z_out: wp.array) -> None:
        model = self._operator.model
        right = np.zeros(self._matrix.size)
        right[: r.size * model.dim] = r.numpy().ravel()
        solution = self._pardiso.solve(right)[: r.size * model.dim]
        z_out.assign(solution.reshape(-1, model.dim).astype(model.types.numpy))

    @property
    def host_bytes(self) -> int:
        """Memory of the factor [bytes]."""
        return self._pardiso.bytes


class _UpperTriangle:
    """The upper triangle of A, or of the larger matrix whose Schur complement it is, in compressed rows.

    Attributes:
        size: rows.
        patch_count: rows beyond those of the points.
        row_starts, columns: int32 arrays.
    """

    def __init__(self, operator: AssembledOperator) -> None:
        self._operator = operator
        d, pattern = operator.model.dim, operator.assembly.pattern
        points = operator.model.point_count
        upper = _ranges(pattern.diagonal, pattern.row_starts[1:])
        rows = np.repeat(np.arange(points), pattern.row_starts[1:] - pattern.diagonal)
        k, m = np.divmod(np.arange(d * d), d)
        row = rows[:, None] * d + k
        column = pattern.columns[upper][:, None] * d + m
        kept = column >= row
        row, column = row[kept], column[kept]
        source = (upper[:, None] * d * d + np.arange(d * d))[kept]
        free = operator.free.numpy().ravel()
        self._free = np.ones(points * d) if len(free) == 0 else free.astype(np.float64)
        self._coupled_rows = np.empty(0, dtype=np.int64)
        self.patch_count = 0
        coupled = []
        for block in operator.averaged:
            starts, own, _, _ = block.coupling_rows()
            patch = points * d + self.patch_count + np.repeat(np.arange(block.patch_count), np.diff(starts))
            coupled.append(((own[:, None] * d + np.arange(d)).ravel(), np.repeat(patch, d)))
            self.patch_count += block.patch_count
        self.size = points * d + self.patch_count
        diagonal = np.arange(points * d, self.size)
        if coupled:
            self._coupled_rows = np.concatenate([own for own, _ in coupled])
            row = np.concatenate([row, self._coupled_rows, diagonal])
            column = np.concatenate([column, *(patch for _, patch in coupled), diagonal])
            source = np.concatenate([source, pattern.columns.size * d * d + np.arange(len(row) - len(source))])
        order = np.lexsort((column, row))
        self._source = source[order]
        self.columns = column[order].astype(np.int32)
        self.row_starts = np.searchsorted(row[order], np.arange(self.size + 1)).astype(np.int32)

    def values(self, shift: float) -> np.ndarray:
        """The entries of the operator's present tangent plus ``shift`` times its diagonal blocks, float64."""
        operator = self._operator
        entries = operator.assembly.blocks.numpy()
        if shift:
            entries = entries.astype(np.float64)
            entries[operator.assembly.pattern.diagonal] *= 1.0 + shift
        entries = entries.ravel()
        if self.patch_count:
            found = [block.coupling_rows() for block in operator.averaged]
            rows = np.concatenate([own.ravel() for _, _, own, _ in found]) * self._free[self._coupled_rows]
            moduli = 1.0 / np.concatenate([inverse for *_, inverse in found]).astype(np.float64)
            entries = np.concatenate([entries, rows, -moduli])
        return entries[self._source].astype(np.float64)


def _ranges(starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """The numbers of all ranges, one after another."""
    lengths = ends - starts
    return np.repeat(starts - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths) + np.arange(lengths.sum())


class _Pardiso:
    """A symmetric matrix of fixed pattern in PARDISO.

    Args:
        row_starts, columns: the upper triangle with all of the diagonal, int32.
    """

    def __init__(self, row_starts: np.ndarray, columns: np.ndarray) -> None:
        self._function = _pardiso()
        self._row_starts, self._columns = row_starts, columns
        self._values = np.ones(len(columns))
        self._handle = np.zeros(64, dtype=np.int64)
        self._options = options = np.zeros(64, dtype=np.int32)
        options[0] = 1  # these, rather than the defaults
        options[1] = 2  # nested dissection
        options[9] = 13  # pivots below 1e-13 of the matrix are replaced
        options[20] = 1  # pivots of 1 x 1 and 2 x 2
        options[34] = 1  # indices count from 0
        self._run(_ANALYSE)

    @property
    def bytes(self) -> int:
        """Memory of the factor [bytes]."""
        return 1024 * int(self._options[15] + self._options[16])

    def factorise(self, values: np.ndarray) -> int:
        """Factors the matrix with these entries; returns how many of its eigenvalues are negative."""
        if not np.isfinite(values).all():
            return len(values)
        self._values = values
        self._run(_FACTORISE)
        return int(self._options[22])

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The solution for a right-hand side, float64."""
        solution = np.empty_like(right)
        self._run(_SOLVE, right, solution)
        return solution

    def _run(self, phase: int, right: np.ndarray | None = None, solution: np.ndarray | None = None) -> None:
        integers = np.array([1, _SYMMETRIC_INDEFINITE, phase, len(self._row_starts) - 1, 0, 0], dtype=np.int32)
        one, kind, step, size, silent, error = (integers[k:].ctypes.data for k in range(6))
        values, row_starts, columns, handle, options = (
            array.ctypes.data for array in (self._values, self._row_starts, self._columns, self._handle, self._options)
        )
        b, x = (None if array is None else array.ctypes.data for array in (right, solution))
        self._function(
            *(handle, one, one, kind, step, size, values, row_starts, columns, None, one, options, silent, b, x, error)
        )
        if integers[5]:
            raise SimulationError(f"PARDISO ended with the error {integers[5]} (see the manual of oneMKL)")

    def __del__(self) -> None:
        if "_handle" in self.__dict__ and self._handle.any():
            self._run(_RELEASE)


@functools.cache
def _pardiso():
    """The function of the library, which gives the same bits whatever the number of threads.

    That is oneMKL's conditional numerical reproducibility, which has to be asked for before anything else.
    """
    from pypardiso import PyPardisoSolver

    library = PyPardisoSolver().libmkl
    library.MKL_CBWR_Set(_REPRODUCIBLE)
    function = library.pardiso
    function.argtypes = [ctypes.c_void_p] * 16
    return function
