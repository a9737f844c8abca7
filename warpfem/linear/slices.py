"""Products with a block-sparse matrix on the CPU, many rows at a time in vector registers.

A slice holds ``SLICE`` rows side by side, as many slots as the longest has blocks, entry by entry with the rows
innermost (sliced ELLPACK: Monakov, Lokhmotov and Avetisyan 2010). Rows of equal length are brought together within a
window, so that few slots are empty (Kreutzer et al. 2014). The compiler turns the loops over the rows into vector code;
see ``vectorized.py`` for what lets it do so.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from warpfem.dtypes import types
from warpfem.launches import Recordings, jobs
from warpfem.threads import Job, Team, share

SLICE = 64
"""Rows of a slice."""

WINDOW = 512
"""Rows among which those of equal length are brought together: their part of a vector fits the first-level cache."""


SLICES_PER_THREAD = 128
"""Slices for which a thread is worth while: handing over work costs as much as some tens, twice in each iteration."""


@functools.cache
def _kernels(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    vector, matrix, scalar = t.vector, t.matrix, t.scalar
    module = f"warpfem.slices_{dim}_{dtype}"
    wp.set_module_options({"cpu_compiler_flags": "-march=native -ffp-contract=fast"}, module=wp.get_module(module))

    @wp.kernel(module=module, enable_backward=False)
    def fill(
        first: int,
        starts: wp.array(dtype=wp.int32),
        sources: wp.array(dtype=wp.int32),
        blocks: wp.array(dtype=matrix),
        values_out: wp.array(dtype=scalar),
    ):
        """Copies the blocks of the rows of slice ``first + tid``; where there is none it writes zeros."""
        own = first + wp.tid()
        numbers = wp.array(ptr=sources.ptr, shape=(0,), dtype=wp.int32)
        entries = wp.array(ptr=blocks.ptr, shape=(0,), dtype=scalar)
        values = wp.array(ptr=values_out.ptr, shape=(0,), dtype=scalar)
        copies = wp.zeros(shape=(wp.static(dim * dim * SLICE),), dtype=scalar)
        for slot in range(starts[own], starts[own + 1]):
            for lane in range(SLICE):
                number = numbers[slot * SLICE + lane]
                for e in range(wp.static(dim * dim)):
                    entry = entries[wp.max(number, 0) * wp.static(dim * dim) + e]
                    copies[e * SLICE + lane] = wp.where(number >= 0, entry, scalar(0.0))
            for place in range(wp.static(dim * dim * SLICE)):
                values[slot * wp.static(dim * dim * SLICE) + place] = copies[place]

    @wp.func
    def put(out: wp.array(dtype=vector), row: int, value: vector):
        if row >= 0:
            out[row] = value

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        first: int,
        starts: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        values: wp.array(dtype=scalar),
        p: wp.array(dtype=vector),
        product_out: wp.array(dtype=vector),
    ):
        """Writes the product of the rows of slice ``first + tid`` with p."""
        own = first + wp.tid()
        c = wp.array(ptr=columns.ptr, shape=(0,), dtype=wp.int32)
        entries = wp.array(ptr=values.ptr, shape=(0,), dtype=scalar)
        factors = wp.array(ptr=p.ptr, shape=(0,), dtype=scalar)
        totals = wp.zeros(shape=(wp.static(dim * SLICE),), dtype=scalar)
        for slot in range(starts[own], starts[own + 1]):
            for lane in range(SLICE):
                j = c[slot * SLICE + lane]
                for k in range(wp.static(dim)):
                    total = totals[k * SLICE + lane]
                    for m in range(wp.static(dim)):
                        e = wp.static(dim) * k + m
                        total += entries[(slot * wp.static(dim * dim) + e) * SLICE + lane] * factors[j + m]
                    totals[k * SLICE + lane] = total
        for lane in range(SLICE):
            result = vector()
            for k in range(wp.static(dim)):
                result[k] = totals[k * SLICE + lane]
            put(product_out, rows[own * SLICE + lane], result)

    @wp.kernel(module=module, enable_backward=False)
    def subtract_product(
        first: int,
        starts: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        values: wp.array(dtype=scalar),
        p: wp.array(dtype=vector),
        b: wp.array(dtype=vector),
        difference_out: wp.array(dtype=vector),
    ):
        """Writes b less the product with p, summed in float64: where they nearly cancel, float32 leaves noise."""
        own = first + wp.tid()
        c = wp.array(ptr=columns.ptr, shape=(0,), dtype=wp.int32)
        entries = wp.array(ptr=values.ptr, shape=(0,), dtype=scalar)
        factors = wp.array(ptr=p.ptr, shape=(0,), dtype=scalar)
        totals = wp.zeros(shape=(wp.static(dim * SLICE),), dtype=wp.float64)
        for slot in range(starts[own], starts[own + 1]):
            for lane in range(SLICE):
                j = c[slot * SLICE + lane]
                for k in range(wp.static(dim)):
                    total = totals[k * SLICE + lane]
                    for m in range(wp.static(dim)):
                        e = wp.static(dim) * k + m
                        entry = entries[(slot * wp.static(dim * dim) + e) * SLICE + lane]
                        total += wp.float64(entry) * wp.float64(factors[j + m])
                    totals[k * SLICE + lane] = total
        for lane in range(SLICE):
            row = rows[own * SLICE + lane]
            right = b[wp.max(row, 0)]
            result = vector()
            for k in range(wp.static(dim)):
                result[k] = scalar(wp.float64(right[k]) - totals[k * SLICE + lane])
            put(difference_out, row, result)

    return SimpleNamespace(fill=fill, multiply=multiply, subtract_product=subtract_product)


class SlicedMatrix:
    """A copy in slices of a matrix in block-compressed rows.

    Args:
        row_starts, columns: the rows, on the host.
        blocks: their blocks, device array.
        dtype: "float32" or "float64".
        team: the threads among which the work is divided.

    Attributes:
        slice_count: slices.
        threads: the threads that share them.
    """

    def __init__(self, row_starts: np.ndarray, columns: np.ndarray, blocks: wp.array, dtype: str, team: Team) -> None:
        dim = blocks.dtype._shape_[0]
        self._kernels = _kernels(dim, dtype)
        self._team = team
        self._recordings = Recordings()
        self._blocks = blocks
        lengths = np.diff(row_starts)
        count = len(lengths)
        self.slice_count = -(-count // SLICE)
        self.threads = max(1, min(team.size, self.slice_count // SLICES_PER_THREAD))
        order = np.lexsort((-lengths, np.arange(count) // WINDOW))
        rows = np.full(self.slice_count * SLICE, -1)
        rows[:count] = order
        ordered = np.zeros(self.slice_count * SLICE, dtype=np.int64)
        ordered[:count] = lengths[order]
        starts = np.concatenate([[0], np.cumsum(ordered.reshape(-1, SLICE).max(axis=1))])
        place = np.empty(count, dtype=np.int64)
        place[order] = np.arange(count)
        of_block = np.repeat(place, lengths)
        slot = starts[of_block // SLICE] + np.arange(len(columns)) - np.repeat(row_starts[:-1], lengths)
        target = slot * SLICE + of_block % SLICE
        sources = np.full(starts[-1] * SLICE, -1)
        sources[target] = np.arange(len(columns))
        factors = np.zeros(starts[-1] * SLICE, dtype=np.int64)
        factors[target] = dim * columns
        self._starts, self._rows, self._columns, self._sources = (
            wp.array(data, dtype=wp.int32, device="cpu") for data in (starts, rows, factors, sources)
        )
        size = int(starts[-1]) * SLICE * dim * dim
        self._values = wp.empty(size, dtype=blocks.dtype._wp_scalar_type_, device="cpu")

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        return [self._starts, self._rows, self._columns, self._sources, self._values]

    def fill(self) -> None:
        """Takes the blocks as they are now."""
        self._run(self._kernels.fill, [self._starts, self._sources, self._blocks], self._values)

    def multiply(self, p: wp.array, product_out: wp.array) -> None:
        """Writes the product with p."""
        self._run(self._kernels.multiply, [*self._matrix(), p], product_out)

    def subtract_product(self, b: wp.array, p: wp.array, difference_out: wp.array) -> None:
        """Writes b less the product with p, summed in float64."""
        self._run(self._kernels.subtract_product, [*self._matrix(), p, b], difference_out)

    def _matrix(self) -> list[wp.array]:
        return [self._starts, self._rows, self._columns, self._values]

    def _run(self, kernel: wp.Kernel, inputs: list[wp.array], out: wp.array) -> None:
        def record() -> list[Job]:
            launches = [
                wp.launch(kernel, len(part), inputs=[part.start, *inputs], outputs=[out], device="cpu", record_cmd=True)
                for part in share(self.slice_count, self.threads)
            ]
            return jobs([[launch] for launch in launches])

        key = (kernel, *(array.ptr for array in inputs), out.ptr)
        self._team.run(self._recordings.get(key, record))
