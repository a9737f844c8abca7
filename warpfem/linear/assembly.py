"""Assembly of the cells' stiffness into block-compressed rows whose pattern is found once, without sorting or atomics.

Each task sums the blocks of one row, from the diagonal on, by a list of the cells' entries, and writes each and its
transpose: the order of every sum is fixed, so that the bits do not depend on how many tasks run at a time.
"""

import functools
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpfem.dtypes import types
from warpfem.launches import Recordings, jobs
from warpfem.model import Model
from warpfem.stiffness import CHUNK, entry_count, entry_numbers
from warpfem.threads import Job, share
from warpfem.vectorized_stiffness import VectorizedStiffness, can_vectorize


@dataclass(frozen=True)
class Pattern:
    """Where the blocks of a symmetric matrix are, and what each is the sum of.

    Attributes:
        row_starts, columns: compressed rows, the columns of each in ascending order.
        diagonal: place of each row's diagonal block.
        upper_starts: number of the first sum of each row: its blocks from the diagonal on are numbered through.
        mirror: place of each sum's transpose.
        sum_starts: first term of each sum.
        terms: twice the number of a cell's entry, plus 1 if its transpose is meant.
    """

    row_starts: np.ndarray
    columns: np.ndarray
    diagonal: np.ndarray
    upper_starts: np.ndarray
    mirror: np.ndarray
    sum_starts: np.ndarray
    terms: np.ndarray


def find_pattern(model: Model, diagonal_only: bool = False) -> Pattern:
    """The pattern of all pairs of points that share a cell, or of the diagonal alone."""
    n = model.point_count
    keys, terms, offset = [], [], 0
    for block in model.blocks:
        corners = block.shape.point_count
        a, b = np.triu_indices(corners)
        entry = offset + entry_numbers(block.count, corners)
        offset += entry_count(block.count, corners)
        if diagonal_only:
            a, b, entry = a[a == b], b[a == b], entry[:, a == b]
        i, j = block.host_cells[:, a].astype(np.int64), block.host_cells[:, b].astype(np.int64)
        keys.append((np.minimum(i, j) * n + np.maximum(i, j)).ravel())
        terms.append((2 * entry + (i > j)).ravel())
    key, term = np.concatenate(keys), np.concatenate(terms)
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
        terms=term[order],
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
        self.pattern = pattern = find_pattern(model, diagonal_only)
        indices = {name: wp.array(data, dtype=wp.int32, device=model.device) for name, data in vars(pattern).items()}
        self.row_starts, self.columns, self.diagonal, *self._sums = indices.values()
        self.blocks = self._new_blocks(len(pattern.columns))
        counts = [entry_count(block.count, block.shape.point_count) for block in model.blocks]
        self._entries = self._new_blocks(sum(counts))
        ends = np.cumsum(counts).tolist()
        self._parts = [self._entries[end - count : end] for end, count in zip(ends, counts, strict=True)]
        self._vectorized = [VectorizedStiffness(block) if can_vectorize(block) else None for block in model.blocks]
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
        key = (kernel, u.ptr, mass_weight, extra.ptr)
        for part in self._recordings.get(key, lambda: self._record(kernel, u, mass_weight, extra)):
            self.model.team.run(part)

    def _record(self, kernel: str, u: wp.array, mass_weight: float, extra: wp.array) -> tuple[list[Job], list[Job]]:
        """The launches of the cells' entries, then those that sum them up, divided among threads."""
        model, size = self.model, self.model.team.size
        cells: list[list[wp.Launch | None]] = [[] for _ in range(size)]
        for block, vectorized, entries in zip(model.blocks, self._vectorized, self._parts, strict=True):
            corners = block.shape.point_count
            for launches, part in zip(cells, share(block.count, size, CHUNK), strict=True):
                if vectorized is not None and kernel == "stiffness":
                    launches += vectorized.record(u, entries, part)
                    continue
                out = entries[entry_count(part.start, corners) : entry_count(part.stop, corners)]
                launches.append(block.launch(kernel, [u], [out], part=slice(part.start, part.stop), record=True))
        inputs = [
            *(self.row_starts, self.columns, self.diagonal, *self._sums),
            *(self._entries, model.mass, mass_weight, extra, self._free),
        ]
        rows = [
            wp.launch(
                _assemble_kernel(model.dim, model.dtype),
                len(part),
                inputs=[part.start, *inputs],
                outputs=[self.blocks],
                device=model.device,
                record_cmd=True,
            )
            for part in share(model.point_count, size)
        ]
        return jobs(cells), jobs([[row] for row in rows])

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        own = [self.row_starts, self.columns, self.diagonal, *self._sums, self.blocks, self._entries]
        return [*own, *(array for each in self._vectorized if each is not None for array in each.arrays())]


@functools.cache
def _assemble_kernel(dim: int, dtype: str) -> wp.Kernel:
    t = types(dim, dtype)
    vector, matrix, scalar = t.vector, t.matrix, t.scalar

    @wp.kernel(module=f"warpfem.assembly_{dim}_{dtype}", enable_backward=False)
    def assemble(
        first: int,
        row_starts: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        diagonal: wp.array(dtype=wp.int32),
        upper_starts: wp.array(dtype=wp.int32),
        mirror: wp.array(dtype=wp.int32),
        sum_starts: wp.array(dtype=wp.int32),
        terms: wp.array(dtype=wp.int32),
        entries: wp.array(dtype=matrix),
        mass: wp.array(dtype=scalar),
        mass_weight: scalar,
        extra: wp.array(dtype=matrix),
        free: wp.array(dtype=vector),
        blocks_out: wp.array(dtype=matrix),
    ):
        """Sums entries, mass and the extra blocks on the diagonal; held rows and columns become those of I."""
        i = first + wp.tid()
        number = upper_starts[i]
        for slot in range(diagonal[i], row_starts[i + 1]):
            total = matrix()
            for k in range(sum_starts[number], sum_starts[number + 1]):
                term = terms[k]
                block = entries[term >> 1]
                if (term & 1) == 1:
                    block = wp.transpose(block)
                total += block
            j = columns[slot]
            if j == i:
                total = scalar(0.5) * (total + wp.transpose(total))
                total += (mass_weight * mass[i]) * wp.identity(n=dim, dtype=scalar)
                if extra.shape[0] > 0:
                    total += extra[i]
            if free.shape[0] > 0:
                total = wp.cw_mul(wp.outer(free[i], free[j]), total)
                if j == i:
                    total += wp.diag(vector(scalar(1.0)) - free[i])
            blocks_out[slot] = total
            if j > i:
                blocks_out[mirror[number]] = wp.transpose(total)
            number += 1

    return assemble
