"""Runs one setting and measures it, in a process that does nothing else."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

import numpy as np
import warp as wp

from warpfem.errors import SceneError, SimulationError, WarpfemError, described
from warpfem.motion import Motion
from warpfem.simulation import Simulation, Summary
from warpfem.threads import available_threads
from warpfem.trade.machine import peak_bytes
from warpfem.trade.outcome import Order, Outcome
from warpfem.trade.problem import Choice, mesh_size

LONG = 0.5
"""Seconds of steps after which a run is long enough to be timed by itself."""


def measure(order: Order) -> Outcome:
    """Runs a setting, once or until its rounds together are long enough to be timed."""
    outcome = Outcome(load=order.load)
    wp.config.log_level = wp.LOG_ERROR
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _measure(order, outcome)
    except WarpfemError as error:
        outcome.failure = "; ".join([str(error), *getattr(error, "__notes__", ())])
    except MemoryError:
        outcome.failure = "out of memory"
    outcome.peak_bytes = outcome.peak_bytes or peak_bytes()
    return outcome


def _measure(order: Order, outcome: Outcome) -> None:
    problem = order.problem
    outcome.by_chance = True
    problem.require_same_files()
    outcome.by_chance = False  # what fails from here on fails again
    choice = problem.build(order.setting)
    threads = order.threads or available_threads()
    with _kernel_seconds() as seconds:
        simulation = _simulation(choice, problem.device, threads)
        outcome.setup_seconds = simulation.summary.setup_seconds - seconds[0]
        motion = Motion.of(simulation)
    outcome.kernel_seconds = seconds[0]
    summary = simulation.summary
    outcome.seconds.append(summary.stepping_seconds)
    outcome.peak_bytes = peak_bytes()
    _describe(outcome, simulation)
    _require_converged(summary)
    if len(order.places) != len(choice.scene.bodies):
        raise SceneError(f"the setting has {len(choice.scene.bodies)} bodies, and the scene {len(order.places)}")
    outcome.times = motion.times
    outcome.motion = np.concatenate(
        [motion.displacement(body.name, at) for body, at in zip(choice.scene.bodies, order.places, strict=True)], axis=1
    )
    for name, quantity in choice.scene.quantities.items():
        try:
            outcome.quantities[name] = float(quantity(motion))
        except Exception as error:  # a user's code
            outcome.missing[name] = str(error) if isinstance(error, WarpfemError) else described(error)
    while len(outcome.seconds) < order.rounds and sum(outcome.seconds) < LONG:
        again = _simulation(choice, problem.device, threads)
        for _ in again.frames():
            pass
        outcome.seconds.append(again.summary.stepping_seconds)


def _simulation(choice: Choice, device: str | None, threads: int) -> Simulation:
    return Simulation(choice.scene, device=device, dtype=choice.dtype, threads=threads)


def _describe(outcome: Outcome, simulation: Simulation) -> None:
    model, summary = simulation.model, simulation.summary
    outcome.cells, outcome.points = model.cell_count, model.point_count
    outcome.mesh_size = mesh_size(simulation.scene)
    outcome.linear_solver = simulation.stepper.linear_solver
    for name in (
        "steps",
        "shortest_dt",
        "longest_dt",
        "newton_iterations",
        "cg_iterations",
        "unconverged_steps",
        "rounded_steps",
    ):
        setattr(outcome, name, getattr(summary, name))


def _require_converged(summary: Summary) -> None:
    if summary.unconverged_steps:
        raise SimulationError(
            f"{summary.unconverged_steps} of {summary.steps} steps did not converge: residual "
            f"{summary.worst_residual:.2e}, {summary.worst_note}"
        )


@contextmanager
def _kernel_seconds() -> Iterator[list[float]]:
    """Gives a list of one number: seconds spent to compile or load kernels inside the block."""
    seconds, depth = [0.0], [0]
    load = wp.Module.load

    def timed(self, *arguments, **options):
        depth[0] += 1
        start = time.perf_counter()
        try:
            return load(self, *arguments, **options)
        finally:
            depth[0] -= 1
            if depth[0] == 0:
                seconds[0] += time.perf_counter() - start

    with patch.object(wp.Module, "load", timed):
        yield seconds
