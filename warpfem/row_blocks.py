"""Blocks of rows of cells (see ``vectorized.py``), and the sums of forces for each point: the same on any threads.

What the cells of a block need of points, and exert on them, is kept for the points of the block alone, in an array
small enough to stay in the first caches, where forces are summed without a race. What the block exerts on each of its
points is added to the force on that point then. A thread has some of the blocks. Where blocks of several threads have a
point in common, the shares of each block are put aside, and added once all threads are done, in the order of the
blocks, just as a single thread adds them.
"""

import functools

import numpy as np
import warp as wp

from warpfem.dtypes import types
from warpfem.packed_points import LANES, packed_size
from warpfem.threads import share

CHUNK = LANES
"""Rows that are taken side by side. What they have of their cells is one stretch of memory, which processors fetch
ahead: with four times as many rows, steps of a million cells take half as long again."""

BLOCK = 64
"""Most chunks of a block: what it has of points fits the first two caches."""


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


class RowBlocks:
    """Blocks of rows divided among threads, and where the forces on their points go.

    Args:
        points: of each row, (chunks * CHUNK, width) int.
        dim: of the space.
        dtype: "float32" or "float64".
        threads: among which the blocks are divided.

    Attributes:
        count: blocks.
        of_thread: the blocks of each thread.
        chunk_starts: (count + 1,) int32, where the chunks of each block begin.
        point_starts: (count + 1,) int32, where the points of each block begin.
        points: of all blocks one after another, int32.
        rows: of each chunk, (chunks, width, CHUNK) uint16: the points of its rows, by their places in the block.
        targets: of the forces on ``points``: their numbers, or -1 - k for those that are put aside in place k.
        aside: what is put aside.
    """

    def __init__(self, points: np.ndarray, dim: int, dtype: str, threads: int) -> None:
        chunk_count = len(points) // CHUNK
        pairs = -(-chunk_count // (2 * BLOCK))  # an even number, as that of threads mostly is
        chunks = share(chunk_count, min(2 * pairs, chunk_count))
        self.count = len(chunks)
        self.of_thread = share(self.count, threads)
        t = types(dim, dtype)
        self._dim, self._scalar = dim, t.scalar
        self._add_aside = _aside_kernel(dim, dtype) if threads > 1 else None

        block = np.repeat(np.arange(self.count), [len(own) * CHUNK for own in chunks])
        point_count = int(points.max()) + 1
        shares, place = np.unique(block[:, None] * point_count + points, return_inverse=True)
        of_share, point = np.divmod(shares, point_count)
        starts = np.searchsorted(of_share, np.arange(self.count + 1))
        self.most_points = int(np.diff(starts).max())
        rows = (place.reshape(points.shape) - starts[block, None]).reshape(chunk_count, CHUNK, -1).transpose(0, 2, 1)
        self.chunk_starts = _device(np.array([0, *(own.stop for own in chunks)]))
        self.point_starts = _device(starts)
        self.points = _device(point)
        self.rows = wp.array(np.ascontiguousarray(rows, dtype=np.uint16).ravel(), dtype=wp.uint16, device="cpu")
        targets, aside_count = self._put_aside(of_share, point, point_count)
        self.targets = _device(targets)
        self.aside = wp.zeros(aside_count, dtype=t.vector, device="cpu")

    def _put_aside(self, block: np.ndarray, point: np.ndarray, point_count: int) -> tuple[np.ndarray, int]:
        """Finds the points that threads have in common; gives the target of each share, and how many are put aside."""
        thread = np.searchsorted([blocks.start for blocks in self.of_thread], block, side="right") - 1
        lowest, highest = np.full(point_count, self.count), np.full(point_count, -1)
        np.minimum.at(lowest, point, thread)
        np.maximum.at(highest, point, thread)
        common = np.flatnonzero((lowest < highest)[point])
        common = common[np.argsort(point[common], kind="stable")]
        self._common, counts = np.unique(point[common], return_counts=True)
        self._common_points = _device(self._common)
        self._aside_starts = _device(np.concatenate([[0], np.cumsum(counts)]))
        targets = point.copy()
        targets[common] = -1 - np.arange(len(common))
        return targets, len(common)

    def scratch(self) -> wp.array:
        """An array for what a thread packs of its block's points, all 0."""
        return wp.zeros(self.most_points * packed_size(self._dim), dtype=self._scalar, device="cpu")

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        own = [self.chunk_starts, self.point_starts, self.points, self.rows, self.targets]
        return [*own, self.aside, self._common_points, self._aside_starts]

    def record_aside(self, force_out: wp.array, points: range) -> wp.Launch | None:
        """The launch that adds what all threads have put aside to some of the points; ``None`` for nothing."""
        first, last = np.searchsorted(self._common, [points.start, points.stop]).tolist()
        if first == last:
            return None
        inputs = [first, self._common_points, self._aside_starts, self.aside]
        return wp.launch(
            self._add_aside, last - first, inputs=inputs, outputs=[force_out], device="cpu", record_cmd=True
        )


def _device(array: np.ndarray) -> wp.array:
    return wp.array(array.astype(np.int32), dtype=wp.int32, device="cpu")
