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

    @wp.kernel(module=module, enable_backward=False)
    def add_up_cells(
        first: int,
        starts: wp.array(dtype=wp.int32),
        terms: wp.array(dtype=wp.int32),
        entries: wp.array(dtype=matrix),
        sums_out: wp.array(dtype=matrix),
    ):
        """Sums the entries that each term, halved, says, or their transposes, where it is odd."""
        number = first + wp.tid()
        total = matrix()
        for k in range(starts[number], starts[number + 1]):
            term = terms[k]
            block = entries[term >> 1]
            if (term & 1) == 1:
                block = wp.transpose(block)
            total += block
        sums_out[number] = total

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
        number = upper_starts[i]
        for slot in range(diagonal[i], row_starts[i + 1]):
            total = matrix()
            for k in range(sum_starts[number], sum_starts[number + 1]):
                total += parts[terms[k]]
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

    return SimpleNamespace(add_up_cells=add_up_cells, assemble=assemble)
