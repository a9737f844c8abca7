"""Assembly of the cells' stiffness into block-compressed rows whose pattern is found once, without sorting or atomics.

The cells are summed in groups first (see ``cell_sums.py``). Then each task sums what the groups have of one row, from
the diagonal on, by a list, and writes each block and its transpose: the order of every sum is fixed, so that bits do
not depend on how many tasks run at a time.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpfem.launches import Recordings, jobs
from warpfem.linear.assembly_kernels import assembly_kernels
from warpfem.linear.cell_sums import CellSums
from warpfem.model import Model
from warpfem.threads import Job, share


@dataclass(frozen=True)
class Pattern:
    """Where the blocks of a symmetric matrix are, and what each is the sum of.

    Attributes:
        row_starts, columns: compressed rows, the columns of each in ascending order.
        diagonal: place of each row's diagonal block.
        upper_starts: number of the first sum of each row: its blocks from the diagonal on are numbered through.
        mirror: place of each sum's transpose.
        sum_starts: first term of each sum.
        terms: the numbers of the groups' sums.
    """

    row_starts: np.ndarray
    columns: np.ndarray
    diagonal: np.ndarray
    upper_starts: np.ndarray
    mirror: np.ndarray
    sum_starts: np.ndarray
    terms: np.ndarray


def find_pattern(point_count: int, first: np.ndarray, second: np.ndarray) -> Pattern:
    """The pattern of a symmetric matrix with blocks for these points i <= j, which may come several times."""
    n = point_count
    key = first * n + second
    order = np.argsort(key, kind="stable")
    key = key[order]
    sum_starts = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1], [True]]))
    upper = key[sum_starts[:-1]]
    i, j = np.divmod(upper, n)
    below = np.flatnonzero(i != j)
    whole = np.concatenate([upper, j[below] * n + i[below]])
    place = np.empty(len(whole), dtype=np.int64)
    place[np.argsort(whole, kind="stable")] = np.arange(len(whole))
    mirror = place[: len(upper)].copy()
    mirror[below] = place[len(upper) :]
    columns = np.empty(len(whole), dtype=np.int64)
    columns[place] = whole % n
    return Pattern(
        row_starts=np.concatenate([[0], np.cumsum(np.bincount(whole // n, minlength=n))]),
        columns=columns,
        diagonal=place[: len(upper)][i == j],
        upper_starts=np.searchsorted(i, np.arange(n)),
        mirror=mirror,
        sum_starts=sum_starts,
        terms=order,
    )


class Assembly:
    """A symmetric matrix of d x d blocks, assembled as often as needed.

    Attributes:
        pattern: its pattern, on the host.
        row_starts, columns, diagonal: that of its blocks, device arrays.
        blocks: the blocks.
    """

    def __init__(self, model: Model, free: wp.array, diagonal_only: bool = False) -> None:
        """
        Args:
            model: the model.
            free: 1 for free and 0 for held components of each point, device array of vectors; empty: all free.
            diagonal_only: whether the diagonal blocks alone are needed.
        """
        self.model = model
        self._sums = [CellSums(block, model.team, diagonal_only) for block in model.blocks]
        first, second = (np.concatenate([getattr(own, name) for own in self._sums]) for name in ("first", "second"))
        self.pattern = pattern = find_pattern(model.point_count, first, second)
        indices = {name: wp.array(data, dtype=wp.int32, device=model.device) for name, data in vars(pattern).items()}
        self.row_starts, self.columns, self.diagonal, *self._lists = indices.values()
        self.blocks = self._new_blocks(len(pattern.columns))
        self._parts = self._new_blocks(len(first))
        ends = np.cumsum([len(own.first) for own in self._sums]).tolist()
        self._parts_of = [self._parts[end - len(own.first) : end] for own, end in zip(self._sums, ends, strict=True)]
        self._free = free
        self._recordings = Recordings()

    def _new_blocks(self, count: int) -> wp.array:
        return wp.empty(count, dtype=self.model.types.matrix, device=self.model.device)

    def assemble(self, kernel: str, u: wp.array, mass_weight: float, extra: wp.array) -> None:
        """Assembles at the displacements ``u``.

        Args:
            kernel: name of the elements' kernel.
            u: displacements, device array.
            mass_weight: what the mass is multiplied by [1/s^2].
            extra: blocks to add on the diagonal, one per point; empty: none.
        """
        for sums, part in zip(self._sums, self._parts_of, strict=True):
            sums.compute(kernel, u, part)
        key = (mass_weight, extra.ptr)
        self.model.team.run(self._recordings.get(key, lambda: self._record(mass_weight, extra)))

    def _record(self, mass_weight: float, extra: wp.array) -> list[Job]:
        model = self.model
        inputs = [
            *(self.row_starts, self.columns, self.diagonal, *self._lists),
            *(self._parts, model.mass, mass_weight, extra, self._free),
        ]
        rows = [
            wp.launch(
                assembly_kernels(model.dim, model.dtype).assemble,
                len(part),
                inputs=[part.start, *inputs],
                outputs=[self.blocks],
                device=model.device,
                record_cmd=True,
            )
            for part in share(model.point_count, model.team.size)
        ]
        return jobs([[row] for row in rows])

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        own = [self.row_starts, self.columns, self.diagonal, *self._lists, self.blocks, self._parts]
        return [*own, *(array for sums in self._sums for array in sums.arrays())]
