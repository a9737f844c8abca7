"""Barriers within the work of several threads: none goes on before all have come, without a detour through Python."""

import ctypes
import functools
import sys
from collections.abc import Sequence

import warp as wp

from warpfem.threads import Job, Team

RELEASED = 2**30
"""What the count is set to so that no thread waits any more."""

_WAIT = """
    typedef wp::int32 (*Rest)(wp::uint32);
    wp::int32* count = counts.data + index;
    __atomic_fetch_add(count, 1, __ATOMIC_ACQ_REL);
    for (wp::int32 turn = 0; __atomic_load_n(count, __ATOMIC_ACQUIRE) < threads; ++turn) {
        if (turn > 7000) {  // more than a rest takes: threads that rest in turn would make each other late for ever
            turn = 7000;
            reinterpret_cast<Rest>(rest_address)(1);
        }
#if defined(__x86_64__)
        __builtin_ia32_pause();
#elif defined(__aarch64__)
        __asm__ volatile("yield");
#endif
    }
"""


@wp.func_native(_WAIT)
def _wait(counts: wp.array(dtype=wp.int32), index: int, threads: int, rest_address: wp.uint64): ...


@functools.cache
def _wait_kernel() -> wp.Kernel:
    @wp.kernel(module="warpfem.barrier", enable_backward=False)
    def wait_for_all(counts: wp.array(dtype=wp.int32), index: int, threads: int, rest_address: wp.uint64):
        """Counts the calling thread, then waits until all are counted: in a loop, then asleep."""
        _wait(counts, index, threads, rest_address)

    return wait_for_all


def _rest_address() -> int:
    """Of the system's function by which a thread lets others have its core, with the microseconds as its argument."""
    if sys.platform == "win32":
        function = ctypes.windll.kernel32.SwitchToThread  # takes none
    else:
        function = ctypes.CDLL(None).usleep
    return ctypes.cast(function, ctypes.c_void_p).value


class Barriers:
    """Barriers that jobs of a team pass one after another, each once in each run.

    Args:
        team: the threads, all of which have to come.
        count: barriers.
    """

    def __init__(self, team: Team, count: int) -> None:
        self._team = team
        self._counts = wp.zeros(count, dtype=wp.int32, device="cpu")
        self._on_host = self._counts.numpy()
        self._rest = wp.uint64(_rest_address())

    def record(self, index: int) -> wp.Launch:
        """The launch that waits at a barrier."""
        inputs = [self._counts, index, self._team.size, self._rest]
        return wp.launch(_wait_kernel(), 1, inputs=inputs, device="cpu", record_cmd=True)

    def run(self, jobs: Sequence[Job]) -> None:
        """Runs the jobs of all threads, each of which launches the waits; none waits for one that has raised."""
        self._on_host[:] = 0
        self._team.run(jobs, self._release)

    def _release(self) -> None:
        self._on_host[:] = RELEASED
