"""Which kernels some code launches, how much memory each launch touches, and how often the host reads an array."""

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import warp as wp

from warpfem.model import device_bytes


@dataclass(frozen=True)
class Launch:
    """A launch of a kernel.

    Attributes:
        kernel: the kernel, or ``None`` for a copy or a fill.
        tasks: tasks of the launch.
        bytes: bytes of its arrays: of inputs once, of outputs, to which most kernels add, twice.
    """

    kernel: wp.Kernel | None
    tasks: int
    bytes: int


@dataclass
class Launches:
    """What has been launched.

    Attributes:
        counts: how often.
        reads: how often the host has read an array, which waits for a device other than the CPU.
    """

    counts: Counter[Launch] = field(default_factory=Counter)
    reads: int = 0

    def kernels(self) -> list[wp.Kernel]:
        """The kernels, each once, in the order of their first launch."""
        return list(dict.fromkeys(launch.kernel for launch in self.counts if launch.kernel is not None))

    def copy(self) -> "Launches":
        """What has been launched so far."""
        return Launches(self.counts.copy(), self.reads)

    def __sub__(self, other: "Launches") -> "Launches":
        return Launches(self.counts - other.counts, self.reads - other.reads)


def _launch_of(kernel: wp.Kernel, dim: Any, inputs: list, outputs: list) -> Launch:
    touched: dict[int, tuple[wp.array, int]] = {}
    for argument, value in zip(kernel.adj.args, [*inputs, *outputs], strict=True):
        if isinstance(value, wp.array) and value.ptr:
            times = 2 if argument.label.endswith("_out") else 1
            before = touched.get(value.ptr, (value, 0))[1]
            touched[value.ptr] = value, max(times, before)
    size = sum(times * device_bytes([array]) for array, times in touched.values())
    tasks = 1
    for count in dim if isinstance(dim, tuple | list) else [dim]:
        tasks *= count
    return Launch(kernel, tasks, size)


@contextlib.contextmanager
def recorded() -> Iterator[Launches]:
    """Notes what is launched inside the ``with`` block, where commands and graphs must be recorded too."""
    result = Launches()
    launch, copy, zero, read, replay = wp.launch, wp.copy, wp.array.zero_, wp.array.numpy, wp.Launch.launch
    replay_graph, graphs = wp.capture_launch, {}

    def noted_launch(
        kernel: wp.Kernel, dim: Any, inputs: Any = (), outputs: Any = (), *args: Any, **options: Any
    ) -> Any:
        returned = launch(kernel, dim, inputs, outputs, *args, **options)
        launched = _launch_of(kernel, dim, list(inputs), list(outputs))
        if returned is None:
            result.counts[launched] += 1
        else:
            returned.noted = launched
        return returned

    def noted_replay(command: wp.Launch, *args: Any, **options: Any) -> None:
        replay(command, *args, **options)
        result.counts[command.noted] += 1

    def noted_copy(target: wp.array, source: wp.array, *args: Any, **options: Any) -> None:
        copy(target, source, *args, **options)
        result.counts[Launch(None, target.size, device_bytes([target, source]))] += 1

    def noted_zero(array: wp.array) -> None:
        zero(array)
        result.counts[Launch(None, array.size, device_bytes([array]))] += 1

    def noted_read(array: wp.array) -> Any:
        result.reads += 1
        return read(array)

    class NotedCapture(wp.ScopedCapture):
        def __enter__(self) -> wp.ScopedCapture:
            self._before = result.copy()
            return super().__enter__()

        def __exit__(self, *exception: Any) -> None:
            super().__exit__(*exception)
            graphs[self.graph] = (result - self._before).counts  # has been captured, and not run
            result.counts = self._before.counts

    def noted_replay_graph(graph: wp.Graph, *args: Any, **options: Any) -> None:
        replay_graph(graph, *args, **options)
        result.counts += graphs[graph]

    with (
        mock.patch.object(wp, "launch", noted_launch),
        mock.patch.object(wp, "copy", noted_copy),
        mock.patch.object(wp.array, "zero_", noted_zero),
        mock.patch.object(wp.array, "numpy", noted_read),
        mock.patch.object(wp.Launch, "launch", noted_replay),
        mock.patch.object(wp, "ScopedCapture", NotedCapture),
        mock.patch.object(wp, "capture_launch", noted_replay_graph),
    ):
        yield result


def launches_of(work: Callable[[], object]) -> Launches:
    """What ``work`` launches, which makes the commands and graphs of its own."""
    with recorded() as result:
        work()
    return result
