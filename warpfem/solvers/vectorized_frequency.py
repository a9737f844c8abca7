"""Estimates of the largest frequency of each linear cell alone, several cells at a time: see ``vectorized.py``.

They are those of the plain kernel (``ElementKernels.frequency``), the largest of each block of strips in a place of its
own.
"""

import functools

import numpy as np
import warp as wp

from warpfem.dtypes import types
from warpfem.elements import LARGE
from warpfem.materials.base import Constitutive
from warpfem.model import CellBlock
from warpfem.packed_points import packed_point_functions
from warpfem.row_blocks import CHUNK
from warpfem.shapes import Shape
from warpfem.tensor import deformation_gradient, direct_rotation
from warpfem.vector_code import MAX_UNROLL, compiler_flags
from warpfem.vectorized import Readers, Row

ROUNDS = 3
"""Of power iteration, as in the plain kernel."""


def can_vectorize(block: CellBlock, density: np.ndarray) -> bool:
    """Whether a block's frequencies can be estimated so: where the forces of linear cells of one density are, unless
    their differential has branches."""
    constitutive = block.kernels.constitutive
    possible = block.vectorized is not None and block.shape.order == 1 and float(np.ptp(density)) == 0.0
    return possible and (constitutive.branchless or constitutive.rotated_differential is not None)


def _rule(constitutive: Constitutive, dim: int, dtype: str) -> tuple[wp.Function, wp.Function]:
    """What of dP depends on the state alone, with 1 where that is known; and dP from it."""
    t = types(dim, dtype)
    matrix = t.matrix
    parameter_vector = wp.types.vector(length=constitutive.parameter_count, dtype=t.scalar)
    stress_differential, rotated_differential = constitutive.stress_differential, constitutive.rotated_differential

    if rotated_differential is None:

        @wp.func
        def tangent(H: matrix):
            return H, 1

        @wp.func
        def differential(H: matrix, R: matrix, dH: matrix, parameters: parameter_vector):
            return stress_differential(H, dH, parameters)

    else:

        @wp.func
        def tangent(H: matrix):
            return direct_rotation(deformation_gradient(H))

        @wp.func
        def differential(H: matrix, R: matrix, dH: matrix, parameters: parameter_vector):
            return rotated_differential(H, R, dH, parameters)

    return tangent, differential


@functools.cache
def _frequency_kernel(constitutive: Constitutive, shape: Shape, dtype: str, uniform: bool) -> wp.Kernel:
    dim, row = shape.dim, Row(shape)
    t = types(dim, dtype)
    scalar, vector, matrix = t.scalar, t.vector, t.matrix
    width, places = row.width, row.places
    read = Readers(width, constitutive.parameter_count, dim, dtype, uniform)
    row_vectors, view, read_row = read.row_vectors, read.view, read.row
    read_gradients, read_parameters = read.gradients, read.parameters
    packed = packed_point_functions(dim, dtype, width)
    values_of_rows = wp.types.vector(length=CHUNK, dtype=scalar)
    pack, load_rows = packed.pack, packed.load_rows
    tangent, differential = _rule(constitutive, dim, dtype)
    options = {"max_unroll": MAX_UNROLL, "cpu_compiler_flags": compiler_flags(4, inlined=30000)}

    @wp.func
    def largest_square(x: row_vectors, B: wp.array(dtype=scalar), p: wp.array(dtype=scalar), lane: int):
        """Of the cells of a strip of density 1, and whether all are known."""
        largest = scalar(0.0)
        known = scalar(1.0)
        for k in range(wp.static(places)):
            gradients = read_gradients(B, k, lane)
            H = matrix()
            Q = matrix()
            first = vector()
            for a in range(wp.static(dim)):
                H += wp.outer(x[k + 1 + a] - x[k], gradients[a])
                Q += wp.outer(gradients[a], gradients[a])
                first += gradients[a]
            Q += wp.outer(first, first)
            scale = wp.trace(Q)
            Q = Q / wp.where(scale > scalar(0.0), scale, scalar(1.0))  # it is 0 where there is no cell
            G = Q
            for i in range(wp.static(dim)):
                G[i, (i + 1) % wp.static(dim)] += scalar(0.1)
            G = deformation_gradient(H) * G  # turned with the body
            own = read_parameters(p, k, lane)
            R, holds = tangent(H)
            known = wp.min(known, scalar(holds))
            size = wp.sqrt(wp.ddot(G, G))
            for _round in range(wp.static(ROUNDS)):
                G = G * (scalar(1.0) / wp.where(size > scalar(0.0), size, scalar(1.0)))
                G = differential(H, R, G, own) * Q
                size = wp.sqrt(wp.ddot(G, G))
            square = scale * size
            largest = wp.where(square <= largest, largest, square)  # not a number stays
        return largest, known

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def strip_frequency(
        first: int,
        chunk_starts: wp.array(dtype=wp.int32),
        point_starts: wp.array(dtype=wp.int32),
        block_points: wp.array(dtype=wp.int32),
        row_points: wp.array(dtype=wp.uint16),
        inverse_shape: wp.array(dtype=scalar),
        parameters: wp.array(dtype=scalar),
        u: wp.array(dtype=vector),
        packed_u: wp.array(dtype=scalar),
        row_u: wp.array(dtype=scalar),
        square_out: wp.array(dtype=scalar),
        known_out: wp.array(dtype=scalar),
    ):
        """Writes the largest squared frequency of block ``first + tid`` at density 1, and whether all are known."""
        block = first + wp.tid()
        pack(u, block_points, point_starts[block], point_starts[block + 1], packed_u)
        displacements = wp.array(ptr=row_u.ptr, shape=(0,), dtype=scalar)
        squares = values_of_rows()
        known = values_of_rows()
        largest = scalar(0.0)
        all_known = scalar(1.0)
        for chunk in range(chunk_starts[block], chunk_starts[block + 1]):
            load_rows(packed_u, row_points, chunk * wp.static(width * CHUNK), row_u)
            B = view(inverse_shape, chunk, wp.static(places * dim * dim))
            p = view(parameters, chunk, wp.static(0 if uniform else places * constitutive.parameter_count))
            for lane in range(wp.static(CHUNK)):
                square, holds = largest_square(read_row(displacements, lane), B, p, lane)
                squares[lane] = square
                known[lane] = holds
            for row in range(wp.static(CHUNK)):
                square = scalar(wp.static(dim + 1)) * squares[row]
                if not (square < scalar(wp.static(LARGE))):
                    square = scalar(wp.static(LARGE))
                largest = wp.max(largest, square)
                all_known = wp.min(all_known, known[row])
        square_out[block] = largest
        known_out[block] = all_known

    return strip_frequency


class VectorizedFrequency:
    """The largest squared frequency of the cells of a block whose forces are vectorised.

    Args:
        block: the block.
        density: of its cells [kg/m^3].
    """

    def __init__(self, block: CellBlock, density: float) -> None:
        force, kernels = block.vectorized, block.kernels
        assert force is not None
        t = kernels.types
        self._kernel = _frequency_kernel(kernels.constitutive, block.shape, t.name, force.uniform)
        self._force = force
        self._density = density
        self._squares = wp.zeros(force.blocks.count, dtype=t.scalar, device="cpu")
        self._known = wp.zeros(force.blocks.count, dtype=t.scalar, device="cpu")

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        return [self._squares, self._known]

    def record(self, u: wp.array, thread: int) -> wp.Launch | None:
        """The launch of a thread's part."""
        blocks, (gradients, _, parameters) = self._force.blocks, self._force.cell_arrays
        packed_u, _, row_u, _ = self._force.scratch[thread]
        own = blocks.of_thread[thread]
        rows = [blocks.chunk_starts, blocks.point_starts, blocks.points, blocks.rows]
        inputs = [own.start, *rows, gradients, parameters, u, packed_u, row_u]
        outputs = [self._squares, self._known]
        return wp.launch(self._kernel, len(own), inputs=inputs, outputs=outputs, device="cpu", record_cmd=True)

    def square(self) -> float | None:
        """The largest [1/s^2], once all parts are done; ``None`` if that of some cell is not known."""
        return float(self._squares.numpy().max()) / self._density if self._known.numpy().all() else None
