"""Stiffness of linear cells on the CPU, several cells at a time in vector registers.

A task takes one column of the blocks K_ab of a chunk of cells, those with a <= b, in a loop over the cells that the
compiler turns into vector code; see ``vectorized.py`` for what lets it do so. For a material with a rotation, that of
each cell is computed before, in a pass of its own, as the forces have it.
"""

import functools

import warp as wp

from warpfem.dtypes import types
from warpfem.materials.base import Constitutive
from warpfem.model import CellBlock
from warpfem.stiffness import CHUNK, pair_count
from warpfem.tensor import deformation_gradient, direct_rotation, polar_rotation
from warpfem.vector_code import compiler_flags

# The results of a loop are more than the uses by which LLVM, as shipped, can tell that they do not alias its inputs,
# and a block has more entries than the members that it would interleave.
_FLAGS = compiler_flags(4, "capture-tracking-max-uses-to-explore=10000", "max-interleave-group-factor=16")


def can_vectorize(block: CellBlock) -> bool:
    """Whether a block's stiffness can be computed so: where the forces of linear cells are, unless its differential has
    branches."""
    constitutive = block.kernels.constitutive
    possible = block.vectorized is not None and block.shape.order == 1
    return possible and (constitutive.branchless or constitutive.rotated_differential is not None)


class _Readers:
    """Kernel functions that read what a cell has, from plain arrays."""

    def __init__(self, parameter_count: int, dim: int, dtype: str, uniform: bool) -> None:
        t = types(dim, dtype)
        scalar, vector, matrix = t.scalar, t.vector, t.matrix
        parameter_vector = wp.types.vector(length=parameter_count, dtype=scalar)
        corners = dim + 1

        @wp.func
        def gradients(inverse_shape: wp.array(dtype=scalar), cell: int):
            value = matrix()
            for a in range(wp.static(dim)):
                for i in range(wp.static(dim)):
                    value[a, i] = inverse_shape[cell * wp.static(dim * dim) + a * wp.static(dim) + i]
            return value

        @wp.func
        def displacement(cells: wp.array(dtype=wp.int32), u: wp.array(dtype=scalar), cell: int, corner: int):
            start = cells[cell * wp.static(corners) + corner] * wp.static(dim)
            value = vector()
            for i in range(wp.static(dim)):
                value[i] = u[start + i]
            return value

        @wp.func
        def displacement_gradient(
            cells: wp.array(dtype=wp.int32), u: wp.array(dtype=scalar), cell: int, own_gradients: matrix
        ):
            origin = displacement(cells, u, cell, 0)
            H = matrix()
            for a in range(wp.static(dim)):
                H += wp.outer(displacement(cells, u, cell, a + 1) - origin, own_gradients[a])
            return H

        @wp.func
        def parameters(p: wp.array(dtype=scalar), cell: int):
            value = parameter_vector()
            for i in range(wp.static(parameter_count)):
                if wp.static(uniform):
                    value[i] = p[i]
                else:
                    value[i] = p[cell * wp.static(parameter_count) + i]
            return value

        @wp.func
        def rotation(rotations: wp.array(dtype=scalar), first: int, lane: int):
            """Of cell ``first + lane`` of those that have been turned, the first of a chunk being ``first``."""
            value = matrix()
            for m in range(wp.static(dim)):
                for k in range(wp.static(dim)):
                    value[m, k] = rotations[(first * wp.static(dim) + m * CHUNK) * wp.static(dim) + k * CHUNK + lane]
            return value

        self.gradients, self.displacement_gradient = gradients, displacement_gradient
        self.parameters, self.rotation = parameters, rotation


@functools.cache
def _rotation_kernel(dim: int, dtype: str) -> wp.Kernel:
    t = types(dim, dtype)
    scalar, vector, matrix = t.scalar, t.vector, t.matrix
    cell_type = wp.types.vector(length=dim + 1, dtype=wp.int32)
    read = _Readers(0, dim, dtype, uniform=True)
    read_gradients, read_displacement_gradient = read.gradients, read.displacement_gradient

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": _FLAGS})
    def cell_rotations(
        first_chunk: int,
        cells: wp.array(dtype=cell_type),
        inverse_shape: wp.array(dtype=matrix),
        u: wp.array(dtype=vector),
        rotations_out: wp.array(dtype=scalar),
    ):
        """Writes the rotations of the cells of chunk ``first_chunk + tid``, entry by entry, the cells innermost."""
        chunk = wp.tid()
        first = (first_chunk + chunk) * CHUNK
        last = cells.shape[0] - 1
        points = wp.array(ptr=cells.ptr, shape=(0,), dtype=wp.int32)
        B = wp.array(ptr=inverse_shape.ptr, shape=(0,), dtype=scalar)
        displacements = wp.array(ptr=u.ptr, shape=(0,), dtype=scalar)
        rotations = wp.zeros(shape=(wp.static(dim * dim * CHUNK),), dtype=scalar)
        known = wp.zeros(shape=(CHUNK,), dtype=scalar)  # integers could alias shapes of arrays
        for lane in range(CHUNK):
            cell = wp.min(first + lane, last)
            H = read_displacement_gradient(points, displacements, cell, read_gradients(B, cell))
            R, holds = direct_rotation(deformation_gradient(H))
            known[lane] = scalar(holds)
            for m in range(wp.static(dim)):
                for k in range(wp.static(dim)):
                    rotations[(m * wp.static(dim) + k) * CHUNK + lane] = R[m, k]
        out = wp.array(ptr=rotations_out.ptr, shape=(0,), dtype=scalar)
        target = chunk * wp.static(dim * dim * CHUNK)
        for entry in range(wp.static(dim * dim * CHUNK)):
            out[target + entry] = rotations[entry]
        for place in range(CHUNK):
            if known[place] == scalar(0.0):
                own = wp.min(first + place, last)
                exact = polar_rotation(
                    deformation_gradient(read_displacement_gradient(points, displacements, own, read_gradients(B, own)))
                )
                for m in range(wp.static(dim)):
                    for k in range(wp.static(dim)):
                        out[target + (m * wp.static(dim) + k) * CHUNK + place] = exact[m, k]

    return cell_rotations


@functools.cache
def _column_kernel(constitutive: Constitutive, dim: int, dtype: str, uniform: bool) -> wp.Kernel:
    t = types(dim, dtype)
    scalar, vector, matrix = t.scalar, t.vector, t.matrix
    corners, pairs = dim + 1, pair_count(dim + 1)
    cell_type = wp.types.vector(length=corners, dtype=wp.int32)
    parameter_vector = wp.types.vector(length=constitutive.parameter_count, dtype=scalar)
    column_type = wp.types.matrix(shape=(corners * dim, dim), dtype=scalar)
    read = _Readers(constitutive.parameter_count, dim, dtype, uniform)
    read_gradients, read_displacement_gradient = read.gradients, read.displacement_gradient
    read_parameters, read_rotation = read.parameters, read.rotation
    stress_differential, rotated_differential = constitutive.stress_differential, constitutive.rotated_differential
    rotated = rotated_differential is not None

    @wp.func
    def corner_gradient(gradients: matrix, b: int):
        """Of the shape function of corner b; those of all add up to zero."""
        result = vector()
        for i in range(wp.static(dim)):
            first = scalar(0.0)
            other = scalar(0.0)
            for a in range(wp.static(dim)):
                first -= gradients[a, i]
                other = wp.where(b == a + 1, gradients[a, i], other)
            result[i] = wp.where(b == 0, first, other)
        return result

    @wp.func
    def column(H: matrix, R: matrix, gradients: matrix, weighted: vector, parameters: parameter_vector):
        """The blocks K_ab of all a, one below the other, from the gradient of b times the volume."""
        result = column_type()
        for k in range(wp.static(dim)):
            axis = vector()
            axis[k] = scalar(1.0)
            if wp.static(rotated):
                dP = rotated_differential(H, R, wp.outer(axis, weighted), parameters)
            else:
                dP = stress_differential(H, wp.outer(axis, weighted), parameters)
            first = vector()
            for a in range(wp.static(dim)):
                force = dP * gradients[a]
                first -= force
                for m in range(wp.static(dim)):
                    result[(a + 1) * wp.static(dim) + m, k] = force[m]
            for m in range(wp.static(dim)):
                result[m, k] = first[m]
        return result

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": _FLAGS})
    def stiffness_columns(
        first_chunk: int,
        cells: wp.array(dtype=cell_type),
        inverse_shape: wp.array(dtype=matrix),
        volume: wp.array(dtype=scalar),
        parameters: wp.array(dtype=parameter_vector),
        u: wp.array(dtype=vector),
        rotations: wp.array(dtype=scalar),
        entries_out: wp.array(dtype=matrix),
    ):
        """Writes the blocks K_ab, a <= b, of the cells of chunk ``first_chunk + tid // corners`` for one b."""
        task = wp.tid()
        own_first = task // wp.static(corners) * CHUNK
        first = first_chunk * CHUNK + own_first
        b = task % wp.static(corners)
        last = cells.shape[0] - 1
        points = wp.array(ptr=cells.ptr, shape=(0,), dtype=wp.int32)
        B = wp.array(ptr=inverse_shape.ptr, shape=(0,), dtype=scalar)
        volumes = wp.array(ptr=volume.ptr, shape=(0,), dtype=scalar)
        p = wp.array(ptr=parameters.ptr, shape=(0,), dtype=scalar)
        displacements = wp.array(ptr=u.ptr, shape=(0,), dtype=scalar)
        own_rotations = wp.array(ptr=rotations.ptr, shape=(0,), dtype=scalar)
        entries = wp.zeros(shape=(wp.static(corners * dim * dim * CHUNK),), dtype=scalar)
        for lane in range(CHUNK):
            cell = wp.min(first + lane, last)  # a chunk that is not full repeats the last one
            gradients = read_gradients(B, cell)
            H = read_displacement_gradient(points, displacements, cell, gradients)
            R = matrix()
            if wp.static(rotated):
                R = read_rotation(own_rotations, own_first, lane)
            weighted = volumes[cell] * corner_gradient(gradients, b)
            own = column(H, R, gradients, weighted, read_parameters(p, cell))
            for row in range(wp.static(corners * dim)):
                for k in range(wp.static(dim)):
                    entries[(row * wp.static(dim) + k) * CHUNK + lane] = own[row, k]
        out = wp.array(ptr=entries_out.ptr, shape=(0,), dtype=scalar)
        for a in range(b + 1):
            pair = a * wp.static(corners) - a * (a - 1) // 2 + b - a
            target = (own_first * wp.static(pairs) + pair * CHUNK) * wp.static(dim * dim)
            source = a * wp.static(dim * dim * CHUNK)
            for place in range(CHUNK):
                for e in range(wp.static(dim * dim)):
                    out[target + place * wp.static(dim * dim) + e] = entries[source + e * CHUNK + place]

    return stiffness_columns


class VectorizedStiffness:
    """The stiffness of the cells of one material, several at a time.

    Args:
        block: the cells.
        most_cells: cells of a launch at most.
        threads: whose launches may run at the same time.
    """

    def __init__(self, block: CellBlock, most_cells: int, threads: int) -> None:
        self._block = block
        kernels = block.kernels
        dtype = kernels.types.name
        uniform = block.arguments["parameters"].strides[0] == 0
        self._corners = kernels.dim + 1
        self._columns = _column_kernel(kernels.constitutive, kernels.dim, dtype, uniform)
        self._turn = None if kernels.constitutive.rotated_differential is None else _rotation_kernel(kernels.dim, dtype)
        size = 0 if self._turn is None else -(-most_cells // CHUNK) * CHUNK * kernels.dim**2
        self._rotations = [wp.empty(size, dtype=kernels.types.scalar, device="cpu") for _ in range(threads)]

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        return self._rotations

    def record(self, u: wp.array, entries_out: wp.array, cells: range, thread: int) -> list[wp.Launch]:
        """The launches, in their order, that write the stiffness of a range of cells, which begins with a chunk.

        Args:
            u: displacements, device array.
            entries_out: the blocks of these cells alone (see ``stiffness.py``), device array.
            cells: the range.
            thread: which of the threads.
        """
        first, count = cells.start // CHUNK, -(-len(cells) // CHUNK)
        points, B, *others = (self._block.arguments[n] for n in ("cells", "inverse_shape", "volume", "parameters"))
        rotations = self._rotations[thread]
        passes = [(self._columns, count * self._corners, [first, points, B, *others, u, rotations], entries_out)]
        if self._turn is not None:
            passes.insert(0, (self._turn, count, [first, points, B, u], rotations))
        return [
            wp.launch(kernel, tasks, inputs=inputs, outputs=[out], device="cpu", record_cmd=True)
            for kernel, tasks, inputs, out in passes
        ]
