"""What a scene requires, and so what is modelled, compiled, stored and paid for."""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import dataclass

from warpfem.dtypes import FloatName
from warpfem.model import device_bytes
from warpfem.profiling import KernelUse, observe_launches
from warpfem.scene import Scene
from warpfem.simulation import Simulation

OBSERVED_SECONDS = 3.0
"""Wall time for which steps are observed."""


@dataclass(frozen=True)
class Term:
    """A term of the model.

    Attributes:
        name: what it is.
        on: whether the scene requires it.
        why: the reason.
    """

    name: str
    on: bool
    why: str


@dataclass(frozen=True)
class Explanation:
    """What a scene requires.

    Attributes:
        headline: size, dimension, precision and device.
        stepping: how time is stepped.
        terms: each term, on or off, and why.
        kernels: the kernels that the observed steps launched.
        other_kernels: kernels of the set-up, of frames, and of steps that were not observed.
        steps: steps observed.
        seconds: wall time of those steps [s].
        model_bytes: device memory of the model and the state.
        solver_bytes: device memory of the solver's work arrays.
    """

    headline: str
    stepping: str
    terms: list[Term]
    kernels: list[KernelUse]
    other_kernels: list[KernelUse]
    steps: int
    seconds: float
    model_bytes: int
    solver_bytes: int

    def __str__(self) -> str:
        width = max(len(term.name) for term in self.terms)
        lines = [self.headline, self.stepping, "", "Terms"]
        lines += [f"  {term.name:<{width}}  {'on ' if term.on else 'off'}  {term.why}" for term in self.terms]
        lines += [
            "",
            f"Kernels: {len(self.kernels) + len(self.other_kernels)}",
            f"  share of a step, launches per step (mean of {self.steps} steps)",
        ]
        for use in sorted(self.kernels, key=lambda use: -use.seconds):
            share = use.seconds / self.seconds
            lines.append(f"  {share:6.1%}  {use.launches / self.steps:7.1f}  {use.label}")
        rest = max(0.0, 1.0 - sum(use.seconds for use in self.kernels) / self.seconds)
        lines += [
            f"  {rest:6.1%}           host",
            f"  set-up, frames, and steps not seen: {', '.join(use.label for use in self.other_kernels)}",
            "",
            f"Device memory: model and state {_size(self.model_bytes)}, solver {_size(self.solver_bytes)}",
        ]
        return "\n".join(lines)


def explain(scene: Scene, *, device: str | None = None, dtype: FloatName = "float32") -> Explanation:
    """Explains a scene: makes it ready, runs it for up to ``OBSERVED_SECONDS`` and watches the kernels.

    Args:
        scene: the scene.
        device: Warp device; ``None`` takes Warp's default.
        dtype: "float32" or "float64".

    Raises:
        SceneError, SimulationError: as :class:`Simulation`, or a step fails.
    """
    with observe_launches(device) as set_up:
        simulation = Simulation(scene, device=device, dtype=dtype)
    model, stepper, state = simulation.model, simulation.stepper, simulation.state
    end, summary = max(1, scene.frames) / scene.fps, simulation.summary
    with observe_launches(model.device) as seen:
        start = time.perf_counter()
        while state.time < end - 1e-9 / scene.fps and time.perf_counter() - start < OBSERVED_SECONDS:
            frames_done = math.floor(state.time * scene.fps + 1e-9)
            simulation.step_towards((frames_done + 1) / scene.fps)
        seconds = time.perf_counter() - start
    limit = stepper.stable_dt()
    if stepper.controls_error:
        dt = f"dt follows the error target: {summary.shortest_dt:.4g} to {summary.longest_dt:.4g} s in the steps seen"
    else:
        stability = "no stability limit" if limit is None else f"stable below {limit:.4g} s at rest"
        dt = f"dt = {simulation.dt:.4g} s, {simulation.steps_per_frame} steps per frame, {stability}"
    linear = [f"linear systems: {stepper.linear_solver}"] if stepper.linear_solver else []
    forces = [f"forces: {stepper.forces}"]
    bodies = f"{len(scene.bodies)} bodies" if len(scene.bodies) > 1 else "1 body"
    return Explanation(
        headline=(
            f"{scene.dim}D, {bodies}, {model.point_count} points, {model.cell_count} cells, "
            f"{model.dtype} on {model.device}"
        ),
        stepping="\n".join([repr(simulation.solver), dt, *linear, *forces]),
        terms=_terms(simulation),
        kernels=list(seen.kernels.values()),
        other_kernels=[use for key, use in set_up.kernels.items() if key not in seen.kernels],
        steps=summary.steps,
        seconds=seconds,
        model_bytes=device_bytes([*model.arrays(), state.u, state.v]),
        solver_bytes=device_bytes(stepper.arrays()),
    )


def _terms(simulation: Simulation) -> list[Term]:
    scene, model = simulation.scene, simulation.model
    cells: Counter[str] = Counter()
    for body in scene.bodies:
        kind = "cells" if body.element == "linear" else f"{body.element} cells"
        cells[f"{body.material.name} ({{}} {kind})"] += body.mesh.cell_count
    loads = [load for body in scene.bodies for load in body.loads]
    kinds = Counter(type(obstacle).__name__ for obstacle in scene.obstacles)
    frictions = sorted({obstacle.friction for obstacle in scene.obstacles if obstacle.friction > 0.0})
    return [
        Term("elasticity", True, ", ".join(text.format(count) for text, count in cells.items())),
        Term(
            "gravity",
            scene.gravity is not None,
            "the scene has no gravity" if scene.gravity is None else f"{tuple(scene.gravity)} m/s^2, a constant load",
        ),
        Term("loads", bool(loads), f"{len(loads)}, constant" if loads else "no body has loads"),
        Term(
            "supports",
            model.supports is not None,
            "no body has supports"
            if model.supports is None
            else f"{model.supports.count} held points, {'some moving' if model.supports.moving else 'all pinned'}",
        ),
        Term(
            "damping",
            scene.damping > 0.0,
            f"alpha = {scene.damping:g} 1/s" if scene.damping > 0.0 else "the scene's damping is 0",
        ),
        Term(
            "contact",
            model.contact is not None,
            ", ".join(f"{count} {kind}" for kind, count in kinds.items())
            or "the scene has no obstacles (bodies do not touch each other)",
        ),
        Term(
            "friction",
            bool(frictions),
            f"coefficients {', '.join(f'{value:g}' for value in frictions)}"
            if frictions
            else "no obstacle has friction",
        ),
    ]


def _size(count: float) -> str:
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} GB"
