"""Recorded launches, which cost a fraction of others, and passes of them that are divided among threads."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, TypeVar

import warp as wp

from warpfem.profiling import observing
from warpfem.threads import Job

MOST_RECORDED = 8
"""Recordings kept: with a fixed dt there are two or three. Launching one takes a tenth of launching anew."""

MOST_KEPT = 256
"""Launches that a launcher keeps: a step of an implicit scheme has some tens of different ones."""

MOST_SINGLE = 8
"""Launches of one thread up to which a graph of them, each of which costs a tenth, is not worth its making."""

Recording = TypeVar("Recording")


class Launcher:
    """Launches kernels on a device and keeps what it has launched, to launch it again at a fraction of the cost.

    What is kept is found by its kernel and arrays; numbers may change. A tape does not see these launches.
    """

    def __init__(self, device: wp.DeviceLike) -> None:
        self._device = device
        self._kept: dict[tuple, tuple[wp.Launch, list]] = {}

    def __call__(self, kernel: wp.Kernel, tasks: int, inputs: Sequence, outputs: Sequence) -> None:
        """Launches a kernel."""
        arguments = [*inputs, *outputs]
        key = (kernel, tasks, *[(a.ptr, a.size) for a in arguments if isinstance(a, wp.array)])
        kept = self._kept.get(key)
        if kept is None:
            launch = wp.launch(kernel, tasks, inputs=inputs, outputs=outputs, device=self._device, record_cmd=True)
            if launch is None:  # no tasks
                return
            if len(self._kept) == MOST_KEPT:
                self._kept.clear()
            self._kept[key] = launch, arguments
        else:
            launch, own = kept
            for index, value in enumerate(arguments):
                if value is not own[index] and not isinstance(value, wp.array):
                    launch.set_param_at_index(index, value)
                    own[index] = value
        launch.launch()


class Total:
    """A float64 number on a device that kernels add to.

    Attributes:
        array: the number, for kernels.
    """

    def __init__(self, device: wp.DeviceLike) -> None:
        self.array = wp.zeros(1, dtype=wp.float64, device=device)
        self._view = self.array.numpy() if wp.get_device(device).is_cpu else None  # making the view costs a launch

    def clear(self) -> None:
        """Sets it to 0."""
        if self._view is None:
            self.array.zero_()
        else:
            self._view[0] = 0.0

    def read(self) -> float:
        """Its value."""
        view = self.array.numpy() if self._view is None else self._view
        return float(view[0])


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


@dataclass(frozen=True, eq=False)
class Replay:
    """A job that launches a graph.

    Attributes:
        graph: what has been captured.
        held: what else the graph needs, since it knows arrays by their addresses alone.
    """

    graph: wp.Graph
    held: object

    def __call__(self) -> None:
        wp.capture_launch(self.graph)


def captured(launch: Job, around: AbstractContextManager) -> Replay:
    """What ``launch`` launches on the CPU, and ``around`` before and after it, as a graph."""
    with wp.ScopedCapture(device="cpu") as capture, around:
        launch()
    return Replay(capture.graph, around)


def jobs(
    launches: Sequence[Iterable[wp.Launch | None]],
    context: Callable[[], AbstractContextManager] = nullcontext,
    as_graphs: bool = True,
) -> list[Job]:
    """A job of launches for each thread.

    Args:
        launches: of each thread, one after another; ``None``, which Warp records where there is no task, is left out.
        context: what threads other than the calling one enter meanwhile; launches of its own are captured, too.
        as_graphs: whether to make graphs of them where that pays; a graph cannot be a part of another.
    """

    def job(own: list[wp.Launch], around: AbstractContextManager) -> Job:
        def launch() -> None:
            with around:
                for each in own:
                    each.launch()

        if not own or not as_graphs or observing() or (len(launches) == 1 and len(own) <= MOST_SINGLE):
            return launch
        with wp.ScopedCapture(device=own[0].device) as capture:  # a graph takes Python's lock once, which others want
            launch()
        return Replay(capture.graph, around)

    return [
        job([each for each in own if each is not None], context() if thread else nullcontext())
        for thread, own in enumerate(launches)
    ]
