"""Threads of the CPU that run kernels side by side: Warp runs each launch on one, and lets go of Python meanwhile."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from itertools import pairwise
from queue import SimpleQueue

Job = Callable[[], None]


def available_threads() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Team:
    """The calling thread and others that wait for work.

    Handing over work takes tens of microseconds, so that it pays for jobs of some hundreds.

    Attributes:
        size: threads, the calling one included.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._inboxes: list[SimpleQueue[Job | None]] = [SimpleQueue() for _ in range(size - 1)]
        self._outbox: SimpleQueue[BaseException | None] = SimpleQueue()
        for inbox in self._inboxes:
            threading.Thread(target=_work, args=(inbox, self._outbox), daemon=True).start()

    def run(self, jobs: Sequence[Job]) -> None:
        """Runs at most ``size`` jobs at the same time, the first by the calling thread, and waits for all.

        Raises:
            BaseException: what a job has raised, once all have ended.
        """
        others = jobs[1:]
        for inbox, job in zip(self._inboxes, others, strict=False):
            inbox.put(job)
        outcomes: list[BaseException | None] = []
        try:
            jobs[0]()
        except BaseException as failure:
            outcomes.append(failure)
        outcomes += [self._outbox.get() for _ in others]
        for outcome in outcomes:
            if outcome is not None:
                raise outcome

    def __del__(self) -> None:
        for inbox in self._inboxes:
            inbox.put(None)


def _work(inbox: SimpleQueue[Job | None], outbox: SimpleQueue[BaseException | None]) -> None:
    while (job := inbox.get()) is not None:
        try:
            job()
        except BaseException as failure:
            outbox.put(failure)
        else:
            outbox.put(None)


def share(count: int, parts: int, unit: int = 1) -> list[range]:
    """Divides ``range(count)`` into nearly equal ranges that begin at multiples of ``unit``."""
    units = -(-count // unit)
    ends = [min(count, units * k // parts * unit) for k in range(parts + 1)]
    return [range(start, end) for start, end in pairwise(ends)]
