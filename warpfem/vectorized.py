"""Internal forces of linear cells on the CPU, several cells at a time in vector registers.

One task takes a chunk of strips (see ``strips.py``) in a loop over unit-stride data with the strips in the innermost
place, which the compiler turns into vector code of the width that the processor has. The forces on the points of the
strips go to an array of their own; a second kernel sums them for each point through an index list, always in the same
order: without atomics, with the same bits however the tasks are divided among threads.

What lets the compiler do it: the material's stress has no branches (``Constitutive.branchless``); results are kept on
the stack until the loop ends, where they cannot alias its inputs; arrays are seen through views of length 0 (Warp adds
the length to negative indices, and adding 0 needs no test) with strides that are known at compile time.
"""

import functools
import platform

import numpy as np
import warp as wp

from warpfem.dtypes import types
from warpfem.elements import ElementKernels
from warpfem.materials.base import Constitutive
from warpfem.strips import STRIP, cut_into_strips

CHUNK = 64
"""Strips of one task: their forces (4.6 kB in single precision) fit the first-level cache with all else."""

LANES = 8
"""Points that are summed at a time."""

WINDOW = 512
"""Points among which those of equal numbers of strips are brought together, so that lanes are not idle."""


def _compiler_flags(depth: int) -> str:
    """Warp's own flags with fused multiply-adds, the widest registers, and a depth for straight-line vector code."""
    flags = "-march=native -ffp-contract=fast -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
    if platform.machine() in ("x86_64", "AMD64"):
        flags += " -mprefer-vector-width=512"
    return f"{flags} -mllvm=-slp-recursion-max-depth={depth}"


@functools.cache
def _force_kernel(constitutive: Constitutive, dim: int, dtype: str, uniform: bool) -> wp.Kernel:
    t = types(dim, dtype)
    scalar, vector, matrix = t.scalar, t.vector, t.matrix
    parameter_count = constitutive.parameter_count
    parameter_vector = wp.types.vector(length=parameter_count, dtype=scalar)
    width = STRIP + dim
    strip_vectors = wp.types.matrix(shape=(width, dim), dtype=scalar)
    stress = constitutive.stress

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": _compiler_flags(4)})
    def strip_force(
        first: int,
        strip_points: wp.array(dtype=wp.int32),
        inverse_shape: wp.array(dtype=scalar),
        volume: wp.array(dtype=scalar),
        parameters: wp.array(dtype=scalar),
        u: wp.array(dtype=vector),
        force_out: wp.array(dtype=scalar),
    ):
        """Writes the internal forces on the points of the strips of chunk ``first + tid``."""
        chunk = first + wp.tid()
        own_points = wp.array(ptr=strip_points.ptr, shape=(0,), dtype=wp.int32)
        B = wp.array(ptr=inverse_shape.ptr, shape=(0,), dtype=scalar)
        volumes = wp.array(ptr=volume.ptr, shape=(0,), dtype=scalar)
        p = wp.array(ptr=parameters.ptr, shape=(0,), dtype=scalar)
        displacement = wp.array(ptr=u.ptr, shape=(0,), dtype=scalar)
        forces = wp.zeros(shape=(wp.static(width * dim * CHUNK),), dtype=scalar)
        for lane in range(wp.static(CHUNK)):
            x = strip_vectors()
            for a in range(wp.static(width)):
                offset = own_points[(chunk * wp.static(width) + a) * wp.static(CHUNK) + lane]
                for i in range(wp.static(dim)):
                    x[a, i] = displacement[offset + i]
            f = strip_vectors()
            for k in range(wp.static(STRIP)):
                cell = (chunk * wp.static(STRIP) + k) * wp.static(CHUNK)
                gradients = matrix()
                H = matrix()
                for a in range(wp.static(dim)):
                    for i in range(wp.static(dim)):
                        gradients[a, i] = B[
                            cell * wp.static(dim * dim) + (a * wp.static(dim) + i) * wp.static(CHUNK) + lane
                        ]
                    H += wp.outer(x[k + 1 + a] - x[k], gradients[a])
                own = parameter_vector()
                for i in range(wp.static(parameter_count)):
                    if wp.static(uniform):
                        own[i] = p[i]
                    else:
                        own[i] = p[cell * wp.static(parameter_count) + i * wp.static(CHUNK) + lane]
                weighted = -volumes[cell + lane] * stress(H, own)
                for a in range(wp.static(dim)):
                    corner = weighted * gradients[a]
                    f[k + 1 + a] += corner
                    f[k] -= corner
            for a in range(wp.static(width)):
                for i in range(wp.static(dim)):
                    forces[(a * wp.static(dim) + i) * wp.static(CHUNK) + lane] = f[a, i]
        out = wp.array(ptr=force_out.ptr, shape=(0,), dtype=scalar)
        for entry in range(wp.static(width * dim * CHUNK)):
            out[chunk * wp.static(width * dim * CHUNK) + entry] = forces[entry]

    return strip_force


@functools.cache
def _sum_kernel(dim: int, dtype: str) -> wp.Kernel:
    t = types(dim, dtype)
    scalar, vector = t.scalar, t.vector
    rows = wp.types.matrix(shape=(dim, LANES), dtype=scalar)

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": _compiler_flags(12)})
    def sum_strip_forces(
        first: int,
        entry_starts: wp.array(dtype=wp.int32),
        entries: wp.array(dtype=wp.int32),
        points: wp.array(dtype=wp.int32),
        strip_forces: wp.array(dtype=scalar),
        force_out: wp.array(dtype=vector),
    ):
        """Adds to each of the points of group ``first + tid`` the forces of its strips."""
        group = first + wp.tid()
        places = wp.array(ptr=entries.ptr, shape=(0,), dtype=wp.int32)
        forces = wp.array(ptr=strip_forces.ptr, shape=(0,), dtype=scalar)
        total = rows()
        for entry in range(entry_starts[group], entry_starts[group + 1]):
            term = rows()
            for lane in range(wp.static(LANES)):
                place = places[entry * wp.static(LANES) + lane]
                for i in range(wp.static(dim)):
                    term[i, lane] = forces[place + i * wp.static(CHUNK)]
            total += term
        for lane in range(wp.static(LANES)):
            point = points[group * wp.static(LANES) + lane]
            if point >= 0:
                value = vector()
                for i in range(wp.static(dim)):
                    value[i] = total[i, lane]
                force_out[point] += value

    return sum_strip_forces


class VectorizedForce:
    """The internal force of the cells of one material, in strips.

    Args:
        kernels: the plain kernels of the material.
        host_cells: (count, dim + 1) int, the cells' points in the model.
        rest_points: of the model, (point_count, dim) [m].
        inverse_shape: D_m^-1 of each cell, (count, dim, dim) [1/m].
        volumes: (count,) [m^3].
        parameters: the material's, (1, k) if uniform, else (count, k).
    """

    def __init__(
        self,
        kernels: ElementKernels,
        host_cells: np.ndarray,
        rest_points: np.ndarray,
        inverse_shape: np.ndarray,
        volumes: np.ndarray,
        parameters: np.ndarray,
    ) -> None:
        t = kernels.types
        dim = self.dim = kernels.dim
        self._scalar = t.scalar
        dtype = "float32" if t.scalar is wp.float32 else "float64"
        uniform = len(parameters) == 1
        self._force = _force_kernel(kernels.constitutive, dim, dtype, uniform)
        self._sum = _sum_kernel(dim, dtype)
        strips = cut_into_strips(rest_points, host_cells)
        self.chunk_count = -(-len(strips.cells) // CHUNK)
        missing = self.chunk_count * CHUNK - len(strips.cells)
        points = np.pad(strips.points, ((0, missing), (0, 0)), mode="edge")
        cells = np.pad(strips.cells, ((0, missing), (0, 0)), constant_values=-1)
        real = cells >= 0
        self.arrays_by_name = {
            "strip_points": self._blocked(dim * points, wp.int32),
            "inverse_shape": self._blocked(self._gradients(host_cells, inverse_shape, points, cells), t.scalar),
            "volume": self._blocked(np.where(real, volumes[cells], 0.0), t.scalar),
            "parameters": wp.array(parameters.ravel(), dtype=t.scalar, device="cpu")
            if uniform
            else self._blocked(np.where(real[:, :, None], parameters[cells], parameters[0]), t.scalar),
        }
        width = STRIP + dim
        size = self.chunk_count * width * dim * CHUNK
        self._strip_forces = wp.zeros(size + dim * CHUNK, dtype=t.scalar, device="cpu")  # zeros at the end, for padding
        self._list_entries(points, real, zero=size)

    def _blocked(self, rows: np.ndarray, dtype: type) -> wp.array:
        """Rows of strips (count, ...) as one array with the strips of a chunk innermost."""
        blocks = rows.reshape(self.chunk_count, CHUNK, -1).transpose(0, 2, 1)
        return wp.array(np.ascontiguousarray(blocks, dtype=wp.dtype_to_numpy(dtype)).ravel(), dtype=dtype, device="cpu")

    def _gradients(
        self, host_cells: np.ndarray, inverse_shape: np.ndarray, points: np.ndarray, cells: np.ndarray
    ) -> np.ndarray:
        """D_m^-1 (count, STRIP, dim, dim) with the corners of each cell in the order of its strip; 0 for none."""
        result = np.zeros((*cells.shape, self.dim, self.dim))
        gradients = np.concatenate([-inverse_shape.sum(axis=1, keepdims=True), inverse_shape], axis=1)
        for k in range(STRIP):
            rows = np.flatnonzero(cells[:, k] >= 0)
            own = cells[rows, k]
            corners = points[rows, k + 1 : k + 1 + self.dim]
            places = (corners[:, :, None] == host_cells[own][:, None, :]).argmax(axis=2)
            result[rows, k] = gradients[own[:, None], places]
        return result

    def _list_entries(self, points: np.ndarray, real: np.ndarray, zero: int) -> None:
        """The places of the forces on each point, for ``LANES`` points at a time."""
        width, dim = points.shape[1], self.dim
        occupied = np.zeros(points.shape, dtype=bool)
        for k in range(STRIP):
            occupied[:, k : k + dim + 1] |= real[:, k, None]
        strip, a = np.nonzero(occupied)
        place = (strip // CHUNK * width + a) * (dim * CHUNK) + strip % CHUNK
        point = points[strip, a]
        order = np.argsort(point, kind="stable")
        point, place = point[order], place[order]
        own, first, counts = np.unique(point, return_index=True, return_counts=True)
        window = own // WINDOW
        members = np.lexsort((own, -counts, window))
        self.windows = np.unique(window)
        group_counts = -(-np.bincount(window)[self.windows] // LANES)
        self.group_starts = np.concatenate([[0], np.cumsum(group_counts)])
        starts = np.concatenate([[0], np.cumsum(np.bincount(window)[self.windows])])
        rank = np.searchsorted(self.windows, window[members])
        slot = np.empty(len(own), dtype=np.int64)
        slot[members] = self.group_starts[rank] * LANES + np.arange(len(own)) - starts[rank]
        group_count = int(self.group_starts[-1])
        longest = np.zeros(group_count, dtype=np.int64)
        np.maximum.at(longest, slot // LANES, counts)
        entry_starts = np.concatenate([[0], np.cumsum(longest)])
        entries = np.full((int(entry_starts[-1]), LANES), zero, dtype=np.int32)
        of_entry = np.repeat(np.arange(len(own)), counts)
        turn = np.arange(len(point)) - first[of_entry]
        entries[entry_starts[slot[of_entry] // LANES] + turn, slot[of_entry] % LANES] = place
        group_points = np.full(group_count * LANES, -1, dtype=np.int32)
        group_points[slot] = own

        def device(array: np.ndarray) -> wp.array:
            return wp.array(array.astype(np.int32).ravel(), dtype=wp.int32, device="cpu")

        self._lists = [device(entry_starts), device(entries), device(group_points)]

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        return [*self.arrays_by_name.values(), self._strip_forces, *self._lists]

    def record_forces(self, u: wp.array, chunks: range) -> wp.Launch | None:
        """The launch that computes the forces of a range of chunks at the displacements ``u``; ``None`` for none."""
        inputs = [chunks.start, *self.arrays_by_name.values(), u]
        return wp.launch(
            self._force, len(chunks), inputs=inputs, outputs=[self._strip_forces], device="cpu", record_cmd=True
        )

    def record_sums(self, force_out: wp.array, points: range) -> wp.Launch | None:
        """The launch that then adds the forces on a range of points, of whole windows, to ``force_out``.

        ``None`` where none of the points is of these cells.
        """
        ends = np.searchsorted(self.windows, [points.start // WINDOW, -(-points.stop // WINDOW)])
        first, last = self.group_starts[ends].tolist()
        inputs = [first, *self._lists, self._strip_forces]
        return wp.launch(self._sum, last - first, inputs=inputs, outputs=[force_out], device="cpu", record_cmd=True)

    def add(self, u: wp.array, force_out: wp.array) -> None:
        """Adds the internal forces at ``u`` to ``force_out``."""
        self.record_forces(u, range(self.chunk_count)).launch()
        self.record_sums(force_out, range(len(force_out))).launch()
