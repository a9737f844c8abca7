"""Threads of the CPU that run kernels side by side: Warp runs each launch on one, and lets go of Python meanwhile."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise
from operator import length_hint
from queue import SimpleQueue

CELLS_PER_THREAD = 8192
"""Cells, quadratic ones counted by their quadrature points, for which a thread is worth while: handing over work costs
as much as the forces of some thousand."""

Job = Callable[[], None]

Outcomes = list[BaseException | None]
"""Of the jobs that have ended: what they have raised."""

Task = tuple[Job, Job, Outcomes, SimpleQueue[None]]
"""A job, what to do at once if it fails, where its outcome goes, and what tells the caller to look there."""


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
        self._inboxes: list[SimpleQueue[Task | None]] = [SimpleQueue() for _ in range(size - 1)]
        for inbox in self._inboxes:
            threading.Thread(target=_work, args=(inbox,), daemon=True).start()

    def run(self, jobs: Sequence[Job], release: Job = lambda: None) -> None:
        """Runs at most ``size`` jobs at the same time, the first by the calling thread, and waits for all.

        Args:
            jobs: what to run.
            release: called as soon as a job has failed, by its thread: others may be waiting for it.

        Raises:
            BaseException: what a job has raised, or an interrupt, once all have ended: until then they work on arrays
                that the caller might free.
        """
        outcomes: Outcomes = []
        news: SimpleQueue[None] = SimpleQueue()
        failures: list[BaseException] = []
        tasks = [(job, release, outcomes, news) for job in jobs[1:]]
        left = iter(tasks)
        try:
            deque(map(SimpleQueue.put, self._inboxes, left), maxlen=0)  # no interrupt comes between two of them
            jobs[0]()
        except BaseException as failure:
            release()
            failures.append(failure)
        handed = len(tasks) - length_hint(left)
        while len(outcomes) < handed:
            try:
                while len(outcomes) < handed:
                    news.get()
            except KeyboardInterrupt as interrupt:
                failures.append(interrupt)
        failures += [outcome for outcome in outcomes if outcome is not None]
        if failures:
            raise failures[0]

    def __del__(self) -> None:
        for inbox in self._inboxes:
            inbox.put(None)


def _work(inbox: SimpleQueue[Task | None]) -> None:
    while (task := inbox.get()) is not None:
        job, release, outcomes, news = task
        try:
            job()
        except BaseException as failure:
            release()
            outcomes.append(failure)
        else:
            outcomes.append(None)
        news.put(None)  # may be lost to an interrupt, unlike the outcome


def share(count: int, parts: int, unit: int = 1) -> list[range]:
    """Divides ``range(count)`` into nearly equal ranges that begin at multiples of ``unit``."""
    units = -(-count // unit)
    ends = [min(count, units * k // parts * unit) for k in range(parts + 1)]
    return [range(start, end) for start, end in pairwise(ends)]
