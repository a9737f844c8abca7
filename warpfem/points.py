"""Kernels over points: sums and combinations of vectors. Sums accumulate in float64 at either precision."""

import functools
from types import SimpleNamespace

import warp as wp

from warpfem.dtypes import types

CHUNK = 256
"""Entries that one task of a sum adds up before it adds to the total."""


def chunks(count: int) -> int:
    """Tasks of a sum over ``count`` entries."""
    return (count + CHUNK - 1) // CHUNK


@functools.cache
def point_kernels(dim: int, dtype: str) -> SimpleNamespace:
    """The kernels ``dot`` and ``kinetic_energy``."""
    t = types(dim, dtype)
    vector, scalar = t.vector, t.scalar
    module = f"warpfem.points_{dim}_{dtype}"

    @wp.kernel(module=module, enable_backward=False)
    def dot(a: wp.array(dtype=vector), b: wp.array(dtype=vector), sum_out: wp.array(dtype=wp.float64)):
        """Adds a . b to ``sum_out[0]``."""
        start = wp.tid() * CHUNK
        end = wp.min(start + CHUNK, a.shape[0])
        total = wp.float64(0.0)
        for i in range(start, end):
            p = a[i]
            q = b[i]
            for k in range(dim):
                total += wp.float64(p[k]) * wp.float64(q[k])
        wp.atomic_add(sum_out, 0, total)

    @wp.kernel(module=module, enable_backward=False)
    def kinetic_energy(mass: wp.array(dtype=scalar), v: wp.array(dtype=vector), sum_out: wp.array(dtype=wp.float64)):
        """Adds sum m |v|^2 / 2 to ``sum_out[0]``."""
        start = wp.tid() * CHUNK
        end = wp.min(start + CHUNK, v.shape[0])
        total = wp.float64(0.0)
        for i in range(start, end):
            p = v[i]
            square = wp.float64(0.0)
            for k in range(dim):
                square += wp.float64(p[k]) * wp.float64(p[k])
            total += wp.float64(0.5) * wp.float64(mass[i]) * square
        wp.atomic_add(sum_out, 0, total)

    return SimpleNamespace(dot=dot, kinetic_energy=kinetic_energy)
