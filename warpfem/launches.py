"""Recorded launches, and passes of them that are divided among threads."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar

import warp as wp

from warpfem.threads import Job

MOST_RECORDED = 8
"""Recordings kept: with a fixed dt there are two or three. Launching one takes a tenth of launching anew."""

Recording = TypeVar("Recording")


class Recordings:
    """What has been recorded under some keys: the last few, since arguments like dt may change for ever."""

    def __init__(self) -> None:
        self._recorded: dict[tuple, Any] = {}

    def get(self, key: tuple, record: Callable[[], Recording]) -> Recording:
        """What ``record`` makes the first time."""
        if key not in self._recorded:
            if len(self._recorded) == MOST_RECORDED:
                self._recorded.clear()
            self._recorded[key] = record()
        return self._recorded[key]


def jobs(
    launches: Sequence[Iterable[wp.Launch | None]],
    context: Callable[[], AbstractContextManager] = nullcontext,
) -> list[Job]:
    """A job of launches for each thread.

    Args:
        launches: of each thread, one after another; ``None``, which Warp records where there is no task, is left out.
        context: what threads other than the calling one enter meanwhile.
    """

    def job(own: list[wp.Launch], around: AbstractContextManager) -> Job:
        def launch() -> None:
            with around:
                for each in own:
                    each.launch()

        return launch

    return [
        job([each for each in own if each is not None], context() if thread else nullcontext())
        for thread, own in enumerate(launches)
    ]
