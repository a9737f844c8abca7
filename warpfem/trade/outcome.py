"""What came of running a setting."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from warpfem.trade.machine import facts
from warpfem.trade.problem import Problem, Setting

Load = Literal["serial", "parallel"]
"""Whether other runs of the study ran at the same time."""


@dataclass(frozen=True, eq=False)
class Order:
    """What a worker is asked to run. Plain data, which any process can be sent.

    Attributes:
        problem: the problem.
        setting: the setting.
        places: rest positions of each body at which the motion is recorded [(k, dim) arrays, m].
        rounds: runs of the scene in this process at most, as long as they are short.
        seconds: wall time that the process may take [s].
        load: whether other runs of the study run at the same time.
        threads: threads that explicit steps may use; ``None`` for all cores.
    """

    problem: Problem
    setting: Setting
    places: list[np.ndarray]
    rounds: int
    seconds: float
    load: Load
    threads: int | None = None


@dataclass(eq=False)
class Outcome:
    """What a run of a setting gave.

    Attributes:
        failure: why there is no result; empty if there is one.
        load: whether other runs of the study ran at the same time.
        limit: the wall time that was not enough, if that is why [s].
        by_chance: whether the failure is none of the setting's, such as a process that was killed, or a scene file
            that was not there or had been edited meanwhile.
        seconds: wall time of the steps of each round [s].
        setup_seconds: wall time to build the model, without its kernels [s].
        kernel_seconds: wall time to compile kernels, or to load those compiled before [s].
        peak_bytes: largest memory of the process, recorded motion included.
        cells, points: of the mesh.
        mesh_size: (volume / cells)^(1/dim) [m].
        steps: time steps.
        shortest_dt, longest_dt: their lengths [s].
        newton_iterations, cg_iterations: totals.
        unconverged_steps, rounded_steps: as in :class:`warpfem.Summary`.
        linear_solver: what solved the linear systems, and why.
        quantities: the scene's quantities of interest by name.
        missing: why some of them have no value, by name.
        machine: facts of the machine and versions: of this one, unless another is named.
        times: simulated time of the frames (frames,) [s].
        motion: displacements at the places (frames, places, dim) [m].
    """

    failure: str = ""
    load: Load = "serial"
    limit: float = 0.0
    by_chance: bool = False
    seconds: list[float] = field(default_factory=list)
    setup_seconds: float = 0.0
    kernel_seconds: float = 0.0
    peak_bytes: int = 0
    cells: int = 0
    points: int = 0
    mesh_size: float = 0.0
    steps: int = 0
    shortest_dt: float = 0.0
    longest_dt: float = 0.0
    newton_iterations: int = 0
    cg_iterations: int = 0
    unconverged_steps: int = 0
    rounded_steps: int = 0
    linear_solver: str = ""
    quantities: dict[str, float] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    machine: dict[str, Any] = field(default_factory=facts)
    times: np.ndarray = field(default_factory=lambda: np.zeros(0))
    motion: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 0)))
