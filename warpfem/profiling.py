"""Observes the kernel launches of a piece of code."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from unittest.mock import patch

import warp as wp

GRAPH = ("iteration of conjugate gradients (a graph of the kernels)", "warpfem.graph")
"""Name and module by which a graph of kernels is counted: others are not made while launches are observed."""

_observers = 0


@dataclass
class KernelUse:
    """How one kernel was used.

    Attributes:
        name: the kernel's name.
        module: its Warp module.
        launches: times launched.
        seconds: wall time of the launches [s].
    """

    name: str
    module: str
    launches: int = 0
    seconds: float = 0.0

    @property
    def label(self) -> str:
        """The name, with the obstacle where there is a kernel for each kind."""
        kind = self.module.partition(".contact_")[2].partition("_")[0]
        return f"{self.name} ({kind})" if kind else self.name


@dataclass
class Launches:
    """Kernels launched while they were observed, in the order of their first launch."""

    kernels: dict[tuple[str, str], KernelUse] = field(default_factory=dict)

    def add(self, key: tuple[str, str], seconds: float) -> None:
        """Counts a launch of the kernel with that name and module."""
        use = self.kernels.setdefault(key, KernelUse(*key))
        use.launches += 1
        use.seconds += seconds

    @property
    def names(self) -> set[str]:
        """Names of the kernels launched."""
        return {name for name, _ in self.kernels}


def observing() -> bool:
    """Whether launches are observed, so that kernels should be launched one by one."""
    return _observers > 0


@contextmanager
def observe_launches(device: wp.DeviceLike = None) -> Iterator[Launches]:
    """Counts and times all kernel launches inside the block, each waited for on ``device``.

    A graph of kernels counts as one kernel.
    """
    global _observers
    seen = Launches()
    launch, replay, replay_graph = wp.launch, wp.Launch.launch, wp.capture_launch

    def timed(key: tuple[str, str], call) -> object:
        start = time.perf_counter()
        result = call()
        wp.synchronize_device(device)
        seen.add(key, time.perf_counter() - start)
        return result

    def key_of(kernel: wp.Kernel) -> tuple[str, str]:
        return kernel.func.__name__, kernel.module.name

    def observed_launch(kernel, *args, **kwargs):
        if kwargs.get("record_cmd"):
            return launch(kernel, *args, **kwargs)
        return timed(key_of(kernel), lambda: launch(kernel, *args, **kwargs))

    def observed_replay(self, *args, **kwargs):
        return timed(key_of(self.kernel), lambda: replay(self, *args, **kwargs))

    def observed_graph(*args, **kwargs):
        return timed(GRAPH, lambda: replay_graph(*args, **kwargs))

    with (
        patch.object(wp, "launch", observed_launch),
        patch.object(wp.Launch, "launch", observed_replay),
        patch.object(wp, "capture_launch", observed_graph),
    ):
        _observers += 1
        try:
            yield seen
        finally:
            _observers -= 1
