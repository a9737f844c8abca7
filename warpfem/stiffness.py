"""Kernels of the cells' tangent stiffness K = d²U/du², as d x d blocks between the points of a cell.

K is symmetric, so that only the blocks K_ab with a <= b are written. Cells come in chunks of ``CHUNK``, and in a chunk
the blocks of a pair (a, b) lie together, those of the next pair after them, row by row: :func:`entry_numbers` says
where. Each task computes one cell and writes what no other does.
"""

from typing import Any

import numpy as np
import warp as wp

from warpfem.dtypes import Types
from warpfem.materials.base import Constitutive
from warpfem.shapes import Shape
from warpfem.tensor import deformation_gradient, polar_rotation

CHUNK = 64
"""Cells whose blocks lie together."""


def pair_count(point_count: int) -> int:
    """Blocks that are stored of a cell with that many points."""
    return point_count * (point_count + 1) // 2


def entry_count(cell_count: int, point_count: int) -> int:
    """Blocks for which there must be room: chunks are whole."""
    return -(-cell_count // CHUNK) * CHUNK * pair_count(point_count)


def entry_numbers(cell_count: int, point_count: int) -> np.ndarray:
    """The place of each cell's blocks K_ab, a <= b, row by row, (cell_count, pairs) int."""
    chunk, lane = np.divmod(np.arange(cell_count), CHUNK)
    pairs = pair_count(point_count)
    return (chunk[:, None] * pairs + np.arange(pairs)) * CHUNK + lane[:, None]


def all_blocks(stored: np.ndarray, cell_count: int, point_count: int) -> np.ndarray:
    """The blocks K_ab of cells of that many points, (count, k, k, d, d) float64, from those that are stored."""
    dim = stored.shape[-1]
    rows, columns = np.triu_indices(point_count)
    blocks = np.empty((cell_count, point_count, point_count, dim, dim))
    upper = stored[entry_numbers(cell_count, point_count)].astype(np.float64)
    blocks[:, columns, rows] = upper.swapaxes(-2, -1)
    blocks[:, rows, columns] = upper
    return blocks


@wp.func
def _first_entry(cell: int, pairs: int):
    """The place of a cell's block K_00."""
    return (cell // CHUNK * pairs) * CHUNK + cell % CHUNK


@wp.func
def _put(entries: wp.array(dtype=Any), slot: int, block: Any, place: int):
    """Adds a block to the sum over the quadrature points, which begins with the first."""
    if place > 0:
        entries[slot] = entries[slot] + block
    else:
        entries[slot] = block


def exact_stiffness_kernel(
    shape: Shape,
    types: Types,
    parameter_vector: type,
    kinematics: tuple[wp.Function, wp.Function],
    constitutive: Constitutive,
) -> wp.Kernel:
    """Of the material's own stress differential.

    Args:
        shape: shape of the cells.
        types: the Warp types.
        parameter_vector: type of the material's parameters.
        kinematics: the functions ``shape_gradients`` and ``displacement_gradient`` of ``ElementKernels``.
        constitutive: the material.
    """
    dim, points, places = shape.dim, shape.point_count, shape.quadrature_count
    scalar, vector, matrix = types.scalar, types.vector, types.matrix
    cell_type = wp.types.vector(length=points, dtype=wp.int32)
    shape_gradients, displacement_gradient = kinematics
    others, pairs = points - 1, pair_count(points)
    differentials_type = wp.types.matrix(shape=(dim * dim, dim), dtype=scalar)
    stress_differential, rotated_differential = constitutive.stress_differential, constitutive.rotated_differential
    rotated = rotated_differential is not None

    @wp.func
    def block_of(rows: differentials_type, g: vector):
        entries = rows * g
        block = matrix()
        for k in range(dim):
            for m in range(dim):
                block[m, k] = entries[k * dim + m]
        return block

    @wp.kernel(module="unique", enable_backward=False)
    def element_stiffness(
        cells: wp.array(dtype=cell_type),
        inverse_shape: wp.array(dtype=matrix),
        volume: wp.array(dtype=scalar),
        parameters: wp.array(dtype=parameter_vector),
        u: wp.array(dtype=vector),
        entries_out: wp.array(dtype=matrix),
    ):
        c = wp.tid()
        first = _first_entry(c, pairs)
        count = int(others)
        rounds = int(places)
        for place in range(rounds):
            i = c * places + place
            gradients = shape_gradients(inverse_shape[i], place)
            H = displacement_gradient(u, cells[c], gradients)
            if wp.static(rotated):
                R = polar_rotation(deformation_gradient(H))
            corner = matrix()
            for b in range(count):  # the columns of shape function b + 1
                # row (k, m) is the change of row m of the weighted stress by a displacement along axis k
                rows = differentials_type()
                for k in range(dim):
                    axis = vector()
                    axis[k] = scalar(1.0)
                    dH = wp.outer(axis, gradients[b])
                    if wp.static(rotated):
                        dP = volume[i] * rotated_differential(H, R, dH, parameters[c])
                    else:
                        dP = volume[i] * stress_differential(H, dH, parameters[c])
                    for m in range(dim):
                        rows[k * dim + m] = dP[m]
                column = matrix()
                slot = first + (points + b) * CHUNK
                for a in range(count):
                    block = block_of(rows, gradients[a])
                    column += block
                    if a <= b:
                        _put(entries_out, slot, block, place)
                        slot += (others - 1 - a) * CHUNK
                _put(entries_out, first + (b + 1) * CHUNK, -column, place)  # the gradients of all add up to zero
                corner += column
            _put(entries_out, first, corner, place)

    return element_stiffness


def filtered_stiffness_kernel(
    shape: Shape,
    types: Types,
    parameter_vector: type,
    kinematics: tuple[wp.Function, wp.Function],
    tangent: wp.Function,
) -> wp.Kernel:
    """Of a tangent in principal axes, whose negative eigenvalues have been filtered (see ``ElementKernels``).

    Args:
        shape, types, parameter_vector, kinematics: as for :func:`exact_stiffness_kernel`.
        tangent: the tangent in principal axes, of H and the parameters.
    """
    dim, points, places = shape.dim, shape.point_count, shape.quadrature_count
    scalar, vector, matrix = types.scalar, types.vector, types.matrix
    cell_type = wp.types.vector(length=points, dtype=wp.int32)
    shape_gradients, displacement_gradient = kinematics
    pairs = pair_count(points)
    gradients_type = wp.types.matrix(shape=(points, dim), dtype=scalar)

    @wp.kernel(module="unique", enable_backward=False)
    def filtered_element_stiffness(
        cells: wp.array(dtype=cell_type),
        inverse_shape: wp.array(dtype=matrix),
        volume: wp.array(dtype=scalar),
        parameters: wp.array(dtype=parameter_vector),
        u: wp.array(dtype=vector),
        entries_out: wp.array(dtype=matrix),
    ):
        c = wp.tid()
        count = int(points)
        rounds = int(places)
        for place in range(rounds):
            i = c * places + place
            rest_gradients = shape_gradients(inverse_shape[i], place)
            t = tangent(displacement_gradient(u, cells[c], rest_gradients), parameters[c])
            gradients = gradients_type()  # of the shape functions, in the principal axes of C
            for k in range(wp.static(points - 1)):
                g = rest_gradients[k] * t.V
                gradients[k + 1] = g
                gradients[0] = gradients[0] - g
            slot = _first_entry(c, pairs)
            for a in range(count):
                g = gradients[a]
                for b in range(a, count):
                    h = gradients[b]
                    # K_ab in the principal axes: entry (m, n) is the sum over j, l of dP_mj/dF_nl g_j h_l
                    K = wp.cw_mul(t.stretch, wp.outer(g, h)) + wp.cw_mul(t.swapped, wp.outer(h, g))
                    K += wp.diag(t.same * wp.cw_mul(g, h))
                    _put(entries_out, slot, volume[i] * (t.U * K * wp.transpose(t.U)), place)
                    slot += CHUNK

    return filtered_element_stiffness
