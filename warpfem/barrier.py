"""Barriers within the work of several threads: none goes on before all have come, without a detour through Python."""

import ctypes
import functools
import os
import sys
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from warpfem.threads import Job, Team

RELEASED = 2**30
"""What the count is set to so that no thread waits any more."""

CORES = 1024
"""Cores that Linux knows of in a set."""

_WAIT = """
    typedef wp::int32 (*Rest)(wp::uint32);
    typedef wp::int32 (*OwnCore)();
    typedef wp::int32 (*Allow)(wp::int32, wp::uint64, const void*);
    Rest rest = reinterpret_cast<Rest>(functions.data[0]);
    OwnCore own_core = reinterpret_cast<OwnCore>(functions.data[1]);
    Allow allow = reinterpret_cast<Allow>(functions.data[2]);
    if (own_core) {
        wp::int32 core = own_core();
        bool shared = false;
        for (wp::int32 other = 0; other < thread; ++other)
            shared |= __atomic_load_n(cores.data + other, __ATOMIC_RELAXED) == core;
        if (shared) {
            wp::uint64 free[CORES / 64], any = 0;
            for (wp::int32 k = 0; k < CORES / 64; ++k)
                free[k] = allowed.data[k];
            for (wp::int32 other = 0; other < threads; ++other) {
                wp::int32 taken = __atomic_load_n(cores.data + other, __ATOMIC_RELAXED);
                if (taken >= 0 && taken < CORES)
                    free[taken / 64] &= ~(wp::uint64(1) << taken % 64);
            }
            for (wp::int32 k = 0; k < CORES / 64; ++k)
                any |= free[k];
            if (any) {
                allow(0, CORES / 8, free);
                allow(0, CORES / 8, allowed.data);
                core = own_core();
            }
        }
        __atomic_store_n(cores.data + thread, core, __ATOMIC_RELAXED);
    }
    wp::int32* count = counts.data + index;
    __atomic_fetch_add(count, 1, __ATOMIC_ACQ_REL);
    for (wp::int32 turn = 0; __atomic_load_n(count, __ATOMIC_ACQUIRE) < threads; ++turn) {
        if (turn > 7000) {  // longer than a rest takes: threads that rest in turn would make each other late for ever
            turn = 7000;
            rest(1);
        }
#if defined(__x86_64__)
        __builtin_ia32_pause();
#elif defined(__aarch64__)
        __asm__ volatile("yield");
#endif
    }
"""


@wp.func_native(_WAIT.replace("CORES", str(CORES)))
def _wait(
    counts: wp.array(dtype=wp.int32),
    index: int,
    thread: int,
    threads: int,
    cores: wp.array(dtype=wp.int32),
    allowed: wp.array(dtype=wp.uint64),
    functions: wp.array(dtype=wp.uint64),
): ...


@functools.cache
def _wait_kernel() -> wp.Kernel:
    @wp.kernel(module="warpfem.barrier", enable_backward=False)
    def wait_for_all(
        counts: wp.array(dtype=wp.int32),
        index: int,
        thread: int,
        threads: int,
        cores: wp.array(dtype=wp.int32),
        allowed: wp.array(dtype=wp.uint64),
        functions: wp.array(dtype=wp.uint64),
    ):
        """Counts the calling thread, then waits until all are counted: in a loop, then asleep.

        A thread that was woken on the core of another, where both would take turns for many milliseconds before the
        system moves one, goes to a core that none has, if it may.
        """
        _wait(counts, index, thread, threads, cores, allowed, functions)

    return wait_for_all


def _functions() -> list[int]:
    """Addresses of the system's functions: to rest for some microseconds, to tell the core, and to choose cores."""
    if sys.platform == "win32":
        return [_address(ctypes.windll.kernel32.SwitchToThread), 0, 0]  # takes no time to rest
    system = ctypes.CDLL(None)
    placing = ("sched_getcpu", "sched_setaffinity") if sys.platform == "linux" else ()
    return [_address(system.usleep), *([_address(system[name]) for name in placing] or [0, 0])]


def _address(function: Callable[..., int]) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0


def _allowed_cores() -> np.ndarray:
    """The set of cores that this process may use, as Linux has it, (CORES / 64,) uint64."""
    bits = np.zeros(CORES, dtype=np.uint8)
    if hasattr(os, "sched_getaffinity"):
        bits[[core for core in os.sched_getaffinity(0) if core < CORES]] = 1
    return np.packbits(bits, bitorder="little").view("<u8")


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
        self._cores = wp.full(team.size, -1, dtype=wp.int32, device="cpu")
        self._allowed = wp.array(_allowed_cores(), dtype=wp.uint64, device="cpu")
        self._functions = wp.array(_functions(), dtype=wp.uint64, device="cpu")

    def record(self, index: int, thread: int) -> wp.Launch:
        """The launch by which a thread waits at a barrier."""
        inputs = [self._counts, index, thread, self._team.size, self._cores, self._allowed, self._functions]
        return wp.launch(_wait_kernel(), 1, inputs=inputs, device="cpu", record_cmd=True)

    def run(self, jobs: Sequence[Job]) -> None:
        """Runs the jobs of all threads, each of which launches the waits; none waits for one that has raised."""
        self._on_host[:] = 0
        self._team.run(jobs, self._release)

    def _release(self) -> None:
        self._on_host[:] = RELEASED
