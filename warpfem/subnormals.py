"""Arithmetic without subnormal numbers, those below 1e-38 in single and 1e-308 in double precision.

In bodies that rest, fall freely or are yet to be reached by a wave, products of rounding errors are that small, and x86
processors take tens of times longer over them. Where they count as 0, no displacement changes by more than 1e-38 m.
"""

import functools

import warp as wp

_FLUSH = """
#if defined(__x86_64__)
    int before = __builtin_ia32_stmxcsr();
    __builtin_ia32_ldmxcsr(before | 0x8040);
    return before;
#else
    return 0;
#endif
"""

_RESTORE = """
#if defined(__x86_64__)
    __builtin_ia32_ldmxcsr(before);
#endif
"""


@wp.func_native(_FLUSH)
def _flush() -> int: ...


@wp.func_native(_RESTORE)
def _restore(before: int): ...


@functools.cache
def _kernels() -> tuple[wp.Kernel, wp.Kernel]:
    @wp.kernel(module="warpfem.subnormals", enable_backward=False)
    def flush_subnormals(before_out: wp.array(dtype=wp.int32)):
        before_out[0] = _flush()

    @wp.kernel(module="warpfem.subnormals", enable_backward=False)
    def restore_subnormals(before: wp.array(dtype=wp.int32)):
        _restore(before[0])

    return flush_subnormals, restore_subnormals


class SubnormalsFlushed:
    """A context in which the calling thread takes subnormal numbers as 0; it costs two launches on the CPU."""

    def __init__(self) -> None:
        flush, restore = _kernels()
        before = wp.zeros(1, dtype=wp.int32, device="cpu")
        self._flush = wp.launch(flush, 1, inputs=[], outputs=[before], device="cpu", record_cmd=True)
        self._restore = wp.launch(restore, 1, inputs=[before], device="cpu", record_cmd=True)

    def __enter__(self) -> None:
        self._flush.launch()

    def __exit__(self, *_: object) -> None:
        self._restore.launch()
