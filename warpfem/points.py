"""Kernels over points: sums and combinations of vectors. Sums accumulate in float64 at either precision."""

import functools
from types import SimpleNamespace

import warp as wp

from warpfem.dtypes import types

CHUNK = 256
"""Entries that one task of a sum adds up before it adds to the total."""

LANES = 64
"""Entries that are taken side by side."""


def chunks(count: int) -> int:
    """Tasks of a sum over ``count`` entries."""
    return (count + CHUNK - 1) // CHUNK


@functools.cache
def entry_functions(dim: int, dtype: str) -> SimpleNamespace:
    """The functions ``flat``, which takes points' components as entries of their own, and ``inner``.

    Of a loop over lanes, which are independent of one another, the compiler makes vector code.
    """
    t = types(dim, dtype)
    vector, scalar = t.vector, t.scalar

    @wp.func
    def flat(a: wp.array(dtype=vector)):
        return wp.array(ptr=a.ptr, shape=(0,), dtype=scalar)

    @wp.func
    def inner(a: wp.array(dtype=scalar), b: wp.array(dtype=scalar), start: int, count: int):
        """a . b over a range of entries."""
        lanes = wp.zeros(shape=(LANES,), dtype=wp.float64)
        rounds = count // LANES
        for k in range(rounds):
            for lane in range(LANES):
                i = start + k * LANES + lane
                lanes[lane] = lanes[lane] + wp.float64(a[i]) * wp.float64(b[i])
        result = wp.float64(0.0)
        for rest in range(start + rounds * LANES, start + count):
            result += wp.float64(a[rest]) * wp.float64(b[rest])
        for place in range(LANES):
            result += lanes[place]
        return result

    return SimpleNamespace(flat=flat, inner=inner)


@functools.cache
def point_kernels(dim: int, dtype: str) -> SimpleNamespace:
    """The kernels ``dot`` and ``kinetic_energy``."""
    t = types(dim, dtype)
    vector, scalar = t.vector, t.scalar
    functions = entry_functions(dim, dtype)
    flat, inner = functions.flat, functions.inner
    module = f"warpfem.points_{dim}_{dtype}"

    @wp.kernel(module=module, enable_backward=False)
    def dot(a: wp.array(dtype=vector), b: wp.array(dtype=vector), sum_out: wp.array(dtype=wp.float64)):
        """Adds a . b to ``sum_out[0]``."""
        first = wp.tid() * CHUNK
        count = wp.min(CHUNK, a.shape[0] - first)
        wp.atomic_add(sum_out, 0, inner(flat(a), flat(b), first * dim, count * dim))

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
