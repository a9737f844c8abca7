"""Sums of the cells' stiffness over groups of cells, each small enough to stay in the cache until it is summed.

A block K_ij between two points is the sum of those of the cells about them. Most of these are in one group, whose cells
are computed and summed before those of the next, so that several times less goes through the memory than all cells
have. The order of every sum is fixed, so that the bits do not depend on how the groups are divided among threads.
"""

import numpy as np
import warp as wp

from warpfem.launches import Recordings, jobs
from warpfem.linear.assembly_kernels import assembly_kernels
from warpfem.model import CellBlock
from warpfem.stiffness import CHUNK, entry_count, entry_numbers, pair_count
from warpfem.threads import Job, Team, share
from warpfem.vectorized_stiffness import VectorizedStiffness, can_vectorize

GROUP_BLOCKS = 10240
"""Cells' blocks in a group: 369 kB in three dimensions and single precision, a part of a second-level cache."""


class CellSums:
    """The sums of one material's cells.

    Args:
        block: the cells.
        team: the threads among which the groups are divided.
        diagonal_only: whether the blocks K_ii alone are needed.

    Attributes:
        first, second: the points i <= j of each sum, on the host.
    """

    def __init__(self, block: CellBlock, team: Team, diagonal_only: bool) -> None:
        self._block, self._team = block, team
        self._recordings = Recordings()
        device = block.device
        corners = block.shape.point_count
        size = GROUP_BLOCKS // (pair_count(corners) * CHUNK) * CHUNK
        # a GPU works on all cells at a time
        size = min(max(size, CHUNK), block.count) if device.is_cpu else block.count
        self._groups = [range(start, min(start + size, block.count)) for start in range(0, block.count, size)]
        threads = min(team.size, len(self._groups))
        self._vectorized = VectorizedStiffness(block, size, threads) if can_vectorize(block) else None
        points = block.host_cells.astype(np.int64)
        a, b = np.triu_indices(corners)
        cell = np.arange(block.count)
        entry = entry_numbers(size, corners)[cell % size]
        if diagonal_only:
            a, b, entry = a[a == b], b[a == b], entry[:, a == b]
        i, j = points[:, a], points[:, b]
        bound = int(points.max()) + 1
        key = (((cell // size)[:, None] * bound + np.minimum(i, j)) * bound + np.maximum(i, j)) * 2 + (i > j)
        order = np.argsort(key.ravel(), kind="stable")
        key, turned = np.divmod(key.ravel()[order], 2)
        starts = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1], [True]]))
        middles = starts[1:] - np.add.reduceat(turned, starts[:-1])
        group, pair = np.divmod(key[starts[:-1]], bound * bound)
        self.first, self.second = np.divmod(pair, bound)
        self._sum_starts = np.searchsorted(group, np.arange(len(self._groups) + 1)).tolist()
        self._lists = [
            wp.array(data, dtype=wp.int32, device=device) for data in (starts, middles, entry.ravel()[order])
        ]
        matrix = block.kernels.types.matrix
        self._entries = [wp.empty(entry_count(size, corners), dtype=matrix, device=device) for _ in range(threads)]

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        vectorized = [] if self._vectorized is None else self._vectorized.arrays()
        return [*self._lists, *self._entries, *vectorized]

    def compute(self, kernel: str, u: wp.array, sums_out: wp.array) -> None:
        """Computes the sums.

        Args:
            kernel: name of the elements' kernel.
            u: displacements, device array.
            sums_out: the sums, device array.
        """
        key = (kernel, u.ptr, sums_out.ptr)
        self._team.run(self._recordings.get(key, lambda: self._record(kernel, u, sums_out)))

    def _record(self, kernel: str, u: wp.array, sums_out: wp.array) -> list[Job]:
        block = self._block
        t = block.kernels.types
        add_up = assembly_kernels(t.dim, t.name).add_up_cells
        launches: list[list[wp.Launch | None]] = []
        parts = share(len(self._groups), len(self._entries))
        for thread, (part, entries) in enumerate(zip(parts, self._entries, strict=True)):
            own: list[wp.Launch | None] = []
            for group in part:
                cells = self._groups[group]
                if self._vectorized is not None and kernel == "stiffness":
                    own += self._vectorized.record(u, entries, cells, thread)
                else:
                    own.append(block.launch(kernel, [u], [entries], part=slice(cells.start, cells.stop), record=True))
                first, last = self._sum_starts[group : group + 2]
                own.append(
                    wp.launch(
                        add_up,
                        last - first,
                        inputs=[first, *self._lists, entries],
                        outputs=[sums_out],
                        device=block.device,
                        record_cmd=True,
                    )
                )
            launches.append(own)
        return jobs(launches)
