"""Sums of the forces on rows of cells (see ``vectorized.py``) for each point: without atomics, the same on any threads.

The rows are taken block by block. The forces of a block's rows go to a scratch array, small enough to stay in the cache
of the thread; from there a second kernel adds what the block exerts on each of its points to the force on that point,
and the next block overwrites the scratch. A thread has some of the blocks. Where blocks of several threads have a point
in common, the shares of each block are put aside, and added once all threads are done, in the order of the blocks, just
as a single thread adds them.
"""

import functools

import numpy as np
import warp as wp

from warpfem.dtypes import types
from warpfem.threads import share
from warpfem.vector_code import compiler_flags

CHUNK = 64
"""Rows of one task: their forces (4.6 kB of strips, in single precision) fit the first-level cache with all else."""

BLOCK = 16
"""Most chunks of a block: with 8 more shares are to be added, with 64 threads have less equal work."""

LANES = 8
"""Points that are summed at a time."""


@functools.cache
def _sum_kernel(dim: int, dtype: str) -> wp.Kernel:
    t = types(dim, dtype)
    scalar, vector = t.scalar, t.vector
    rows = wp.types.matrix(shape=(dim, LANES), dtype=scalar)

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": compiler_flags(12)})
    def sum_row_forces(
        first: int,
        entry_starts: wp.array(dtype=wp.int32),
        entries: wp.array(dtype=wp.int32),
        targets: wp.array(dtype=wp.int32),
        row_forces: wp.array(dtype=scalar),
        force_out: wp.array(dtype=vector),
        aside_out: wp.array(dtype=vector),
    ):
        """Adds to the points of group ``first + tid`` the forces of a block's rows, or puts them aside.

        Targets from 0 on are points, those from -2 down places to put aside; -1 is for no point.
        """
        group = first + wp.tid()
        places = wp.array(ptr=entries.ptr, shape=(0,), dtype=wp.int32)
        forces = wp.array(ptr=row_forces.ptr, shape=(0,), dtype=scalar)
        total = rows()
        for entry in range(entry_starts[group], entry_starts[group + 1]):
            term = rows()
            for lane in range(wp.static(LANES)):
                place = places[entry * wp.static(LANES) + lane]
                for i in range(wp.static(dim)):
                    term[i, lane] = forces[place + i * wp.static(CHUNK)]
            total += term
        for lane in range(wp.static(LANES)):
            target = targets[group * wp.static(LANES) + lane]
            value = vector()
            for i in range(wp.static(dim)):
                value[i] = total[i, lane]
            if target >= 0:
                force_out[target] += value
            elif target < -1:
                aside_out[-2 - target] = value

    return sum_row_forces


@functools.cache
def _aside_kernel(dim: int, dtype: str) -> wp.Kernel:
    vector = types(dim, dtype).vector

    @wp.kernel(module="unique", enable_backward=False)
    def add_what_was_put_aside(
        first: int,
        points: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        aside: wp.array(dtype=vector),
        force_out: wp.array(dtype=vector),
    ):
        """Adds to the point of entry ``first + tid`` the shares that were put aside, in the order of the blocks."""
        own = first + wp.tid()
        total = force_out[points[own]]
        for place in range(starts[own], starts[own + 1]):
            total += aside[place]
        force_out[points[own]] = total

    return add_what_was_put_aside


class RowSums:
    """Blocks of rows divided among threads, and what is to be summed for each point.

    Args:
        points: of each row, (chunks * CHUNK, width) int.
        occupied: whether cells exert forces there, same shape.
        dim: of the space.
        dtype: "float32" or "float64".
        threads: among which the blocks are divided.

    Attributes:
        scratch: for the forces of the rows of each thread's block, by chunk, point of the row, component and row.
        blocks: those of each thread, by their numbers.
        chunks: of each block.
    """

    def __init__(self, points: np.ndarray, occupied: np.ndarray, dim: int, dtype: str, threads: int) -> None:
        chunk_count, width = len(points) // CHUNK, points.shape[1]
        pairs = -(-chunk_count // (2 * BLOCK))  # an even number, as that of threads mostly is
        self.chunks = share(chunk_count, min(2 * pairs, chunk_count))
        self.blocks = share(len(self.chunks), threads)
        longest = max(len(chunks) for chunks in self.chunks)
        zero = longest * width * dim * CHUNK
        t = types(dim, dtype)
        self.scratch = [
            wp.zeros(zero + dim * CHUNK, dtype=t.scalar, device="cpu")  # with zeros at the end, for groups with gaps
            for _ in range(threads)
        ]
        self._sum, self._add_aside = _sum_kernel(dim, dtype), _aside_kernel(dim, dtype) if threads > 1 else None

        row, a = np.nonzero(occupied)
        starts = np.array([chunks.start for chunks in self.chunks])
        block = np.searchsorted(starts, row // CHUNK, side="right") - 1
        place = ((row // CHUNK - starts[block]) * width + a) * (dim * CHUNK) + row % CHUNK
        point_count = int(points.max()) + 1
        share_of = block * point_count + points[row, a]
        order = np.argsort(share_of, kind="stable")
        shares, first, counts = np.unique(share_of[order], return_index=True, return_counts=True)
        block, point = np.divmod(shares, point_count)
        targets, aside_count = self._put_aside(block, point, point_count)
        self._aside = wp.zeros(aside_count, dtype=t.vector, device="cpu")
        self._list_entries(place[order], first, counts, block, targets, zero)

    def _put_aside(self, block: np.ndarray, point: np.ndarray, point_count: int) -> tuple[np.ndarray, int]:
        """Finds the points that threads have in common; gives the target of each share, and how many are put aside."""
        thread = np.searchsorted([blocks.start for blocks in self.blocks], block, side="right") - 1
        lowest, highest = np.full(point_count, len(self.blocks)), np.full(point_count, -1)
        np.minimum.at(lowest, point, thread)
        np.maximum.at(highest, point, thread)
        common = np.flatnonzero((lowest < highest)[point])
        common = common[np.argsort(point[common], kind="stable")]
        self._common, counts = np.unique(point[common], return_counts=True)
        self._points = _device(self._common)
        self._aside_starts = _device(np.concatenate([[0], np.cumsum(counts)]))
        targets = point.copy()
        targets[common] = -2 - np.arange(len(common))
        return targets, len(common)

    def _list_entries(
        self,
        places: np.ndarray,
        first: np.ndarray,
        counts: np.ndarray,
        block: np.ndarray,
        targets: np.ndarray,
        zero: int,
    ) -> None:
        """The places of each share, for ``LANES`` shares of a block at a time, those with many entries first."""
        members = np.lexsort((-counts, block))
        per_block = np.bincount(block, minlength=len(self.chunks))
        self._group_starts = np.concatenate([[0], np.cumsum(-(-per_block // LANES))]).tolist()
        before = np.concatenate([[0], np.cumsum(per_block)])
        slot = np.empty(len(block), dtype=np.int64)
        skipped = np.array(self._group_starts)[block] * LANES - before[block]
        slot[members] = skipped[members] + np.arange(len(block))
        group_count = self._group_starts[-1]
        longest = np.zeros(group_count, dtype=np.int64)
        np.maximum.at(longest, slot // LANES, counts)
        entry_starts = np.concatenate([[0], np.cumsum(longest)])
        entries = np.full((int(entry_starts[-1]), LANES), zero, dtype=np.int32)
        of_entry = np.repeat(np.arange(len(block)), counts)
        turn = np.arange(len(places)) - first[of_entry]
        entries[entry_starts[slot[of_entry] // LANES] + turn, slot[of_entry] % LANES] = places
        group_targets = np.full(group_count * LANES, -1, dtype=np.int32)
        group_targets[slot] = targets
        self._lists = [_device(entry_starts), _device(entries), _device(group_targets)]

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        return [*self.scratch, self._aside, self._points, self._aside_starts, *self._lists]

    def record_block(self, block: int, thread: int, force_out: wp.array) -> wp.Launch | None:
        """The launch that adds the forces in the scratch of a thread, those of a block of its, to ``force_out``."""
        first, last = self._group_starts[block], self._group_starts[block + 1]
        inputs = [first, *self._lists, self.scratch[thread]]
        outputs = [force_out, self._aside]
        return wp.launch(self._sum, last - first, inputs=inputs, outputs=outputs, device="cpu", record_cmd=True)

    def record_aside(self, force_out: wp.array, points: range) -> wp.Launch | None:
        """The launch that then adds what all threads have put aside to some of the points; ``None`` for nothing."""
        first, last = np.searchsorted(self._common, [points.start, points.stop]).tolist()
        if first == last:
            return None
        inputs = [first, self._points, self._aside_starts, self._aside]
        return wp.launch(
            self._add_aside, last - first, inputs=inputs, outputs=[force_out], device="cpu", record_cmd=True
        )


def _device(array: np.ndarray) -> wp.array:
    return wp.array(array.astype(np.int32).ravel(), dtype=wp.int32, device="cpu")
