"""The kernels that sum the cells' stiffness, in one module, so that they are compiled together."""

import functools
from types import SimpleNamespace

import warp as wp

from warpfem.dtypes import types


@functools.cache
def assembly_kernels(dim: int, dtype: str) -> SimpleNamespace:
    """The kernels ``add_up_cells`` and ``assemble``."""
    t = types(dim, dtype)
    vector, matrix, scalar = t.vector, t.matrix, t.scalar
    module = f"warpfem.assembly_{dim}_{dtype}"

    # Arrays are seen through views of length 0, which need no test of negative indices.

    @wp.kernel(module=module, enable_backward=False)
    def add_up_cells(
        first: int,
        starts: wp.array(dtype=wp.int32),
        middles: wp.array(dtype=wp.int32),
        terms: wp.array(dtype=wp.int32),
        entries: wp.array(dtype=matrix),
        sums_out: wp.array(dtype=matrix),
    ):
        """Sums the entries of each sum's terms, from the middle on their transposes."""
        number = first + wp.tid()
        middle = middles[number]
        own = wp.array(ptr=entries.ptr, shape=(0,), dtype=matrix)
        places = wp.array(ptr=terms.ptr, shape=(0,), dtype=wp.int32)
        total = matrix()
        for k in range(starts[number], middle):
            total += own[places[k]]
        turned = matrix()
        for m in range(middle, starts[number + 1]):
            turned += own[places[m]]
        sums_out[number] = total + wp.transpose(turned)

    @wp.kernel(module=module, enable_backward=False)
    def assemble(
        first: int,
        row_starts: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        diagonal: wp.array(dtype=wp.int32),
        upper_starts: wp.array(dtype=wp.int32),
        mirror: wp.array(dtype=wp.int32),
        sum_starts: wp.array(dtype=wp.int32),
        terms: wp.array(dtype=wp.int32),
        parts: wp.array(dtype=matrix),
        mass: wp.array(dtype=scalar),
        mass_weight: scalar,
        extra: wp.array(dtype=matrix),
        free: wp.array(dtype=vector),
        blocks_out: wp.array(dtype=matrix),
    ):
        """Sums parts, mass and the extra blocks on the diagonal; held rows and columns become those of I."""
        i = first + wp.tid()
        own = wp.array(ptr=parts.ptr, shape=(0,), dtype=matrix)
        places = wp.array(ptr=terms.ptr, shape=(0,), dtype=wp.int32)
        blocks = wp.array(ptr=blocks_out.ptr, shape=(0,), dtype=matrix)
        number = upper_starts[i]
        for slot in range(diagonal[i], row_starts[i + 1]):
            total = matrix()
            for k in range(sum_starts[number], sum_starts[number + 1]):
                total += own[places[k]]
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
            blocks[slot] = total
            if j > i:
                blocks[mirror[number]] = wp.transpose(total)
            number += 1

    return SimpleNamespace(add_up_cells=add_up_cells, assemble=assemble)
