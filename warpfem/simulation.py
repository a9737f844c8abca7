"""Runs a scene frame by frame."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warpfem.dtypes import FloatName
from warpfem.errors import SceneError, SimulationError, TimeStepError
from warpfem.folds import folds
from warpfem.model import Energies, Model, State
from warpfem.scene import Scene
from warpfem.solvers.base import Solver, StepReport, require_finite, worst_cell
from warpfem.solvers.error_control import controlled_step

SAME_DT = 1e-10
"""Relative difference to which ``dt="auto"`` keeps the last step's length, so that what was recorded for it serves
again: what is left of a frame is known to some roundings, and less than this per step changes no end of a frame."""

AUTO_FRACTION = 0.6
"""The part of the explicit stability limit that ``dt="auto"`` takes: deformation stiffens cells."""

AUTO_INTERVAL = 32
"""Explicit steps after which ``dt="auto"`` looks at the limit again."""

MOST_STEPS = 10**8
"""Steps in a frame that would take an hour even for a single cell."""

LEAST_FRACTION = 1e-3
"""The part of the first step of ``dt="auto"`` below which a run would hardly get on."""


@dataclass(frozen=True, eq=False)
class Frame:
    """What is recorded of one moment.

    Attributes:
        index: 0 for the initial state.
        time: simulated time [s].
        displacement: (point_count, dim) float64 [m].
        velocity: (point_count, dim) float64 [m/s].
        jacobian: J = det F of each cell.
        von_mises: von Mises stress of each cell [Pa], that of |J| = 1e-6 where |J| is less.
        energies: the energies [J].
        penetration: greatest depth inside an obstacle [m].
    """

    index: int
    time: float
    displacement: np.ndarray
    velocity: np.ndarray
    jacobian: np.ndarray
    von_mises: np.ndarray
    energies: Energies
    penetration: float


@dataclass
class Summary:
    """What a run did.

    Attributes:
        frames: frames recorded, the initial one included.
        steps: time steps taken.
        dt: time step [s]; with ``dt="auto"`` the last one.
        shortest_dt, longest_dt: of the steps taken [s]; 0 before the first.
        wanted_dt: the length that the next step of a solver with an error target should have [s].
        rejected_steps: steps that missed the error target, or failed, and were not taken.
        stable_dt: the explicit stability limit that ``dt="auto"`` saw last [s].
        simulated_seconds: simulated time [s].
        setup_seconds: wall time to build the model, and to compile or load its kernels [s].
        stepping_seconds: wall time of the steps [s].
        first_energies, last_energies: energies of the first and the last frame [J].
        largest_von_mises: over all frames [Pa].
        smallest_jacobian: over all frames.
        inverted_cells: cells with J <= 0 in the last frame.
        folds: inner edges (2D: points) in the last frame about which cells turn twice (see ``folds.py``).
        first_penetration: depth inside an obstacle in the first frame [m].
        largest_penetration: over all frames [m].
        newton_iterations, cg_iterations: totals over all steps.
        rounded_steps: implicit steps that rounding kept from their tolerance, with a residual below 1e-2.
        divided_steps: implicit steps that failed as a whole and were taken in parts.
        unconverged_steps: implicit steps that stopped before their tolerance for other reasons, or above 1e-2.
        worst_residual: the largest relative residual among both.
        worst_note: how that step ended.
    """

    dt: float
    setup_seconds: float
    stable_dt: float | None = None
    wanted_dt: float | None = None
    shortest_dt: float = 0.0
    longest_dt: float = 0.0
    rejected_steps: int = 0
    frames: int = 0
    steps: int = 0
    simulated_seconds: float = 0.0
    stepping_seconds: float = 0.0
    first_energies: Energies | None = None
    last_energies: Energies | None = None
    largest_von_mises: float = 0.0
    smallest_jacobian: float = math.inf
    inverted_cells: int = 0
    folds: int = 0
    first_penetration: float = 0.0
    largest_penetration: float = 0.0
    newton_iterations: int = 0
    cg_iterations: int = 0
    rounded_steps: int = 0
    divided_steps: int = 0
    unconverged_steps: int = 0
    worst_residual: float = 0.0
    worst_note: str = ""

    def add_frame(self, frame: Frame) -> None:
        """Takes a frame into account."""
        if self.frames == 0:
            self.first_penetration = frame.penetration
        self.frames += 1
        self.first_energies = self.first_energies or frame.energies
        self.last_energies = frame.energies
        self.largest_von_mises = max(self.largest_von_mises, float(frame.von_mises.max()))
        self.smallest_jacobian = min(self.smallest_jacobian, float(frame.jacobian.min()))
        self.inverted_cells = int((frame.jacobian <= 0.0).sum())
        self.largest_penetration = max(self.largest_penetration, frame.penetration)

    def totals(self) -> dict[str, Any]:
        """What a run that is taken up again has to know, in plain numbers and texts."""
        return {name: value for name, value in asdict(self).items() if name != "setup_seconds"}

    def take_up(self, totals: Mapping[str, Any]) -> None:
        """Goes on from the totals of an earlier run."""
        for name, value in totals.items():
            setattr(self, name, Energies(**value) if isinstance(value, Mapping) else value)


class Simulation:
    """A scene on a device, ready to run.

    Building it compiles or loads every kernel that a step needs, by one step that is thrown away, so that
    mistakes show up before anything is written.

    Args:
        scene: the scene.
        device: Warp device, for example "cpu" or "cuda:0"; ``None`` takes Warp's default.
        dtype: "float32" or "float64".
        solver: takes the place of the scene's.
        threads: threads of the CPU that steps may use; ``None`` takes all cores. Results are the same.

    Attributes:
        scene: the scene.
        model: the scene on the device.
        solver: the solver.
        state: the current state.
        dt: the time step [s]; explicit steps with ``dt="auto"`` change it as the bodies deform, and solvers with an
            error target as the motion asks for.
        steps_per_frame: time steps between two frames, likewise.
        summary: what has been done so far.

    Raises:
        SceneError: the scene refers to something that does not exist or contradicts itself.
        SimulationError: the first step cannot be taken.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        device: str | None = None,
        dtype: FloatName = "float32",
        solver: Solver | None = None,
        threads: int | None = None,
    ) -> None:
        start = time.perf_counter()
        self.scene = scene if solver is None else replace(scene, solver=solver)
        self.model = Model(self.scene, device=device, dtype=dtype, threads=threads)
        self.state = self.model.state()
        self.solver = self.scene.solver
        self.stepper = self.solver.stepper(self.model)
        self._warned: set[str] = set()  # bodies whose inverted cells have been told of
        interval = 1.0 / scene.fps
        self._rest_limit = self.stepper.stable_dt(self.state) if scene.dt == "auto" else None
        self.stepper.adaptive = self._rest_limit is not None
        wanted = scene.dt
        if wanted == "auto":
            wanted = interval if self._rest_limit is None else AUTO_FRACTION * self._rest_limit
        self.steps_per_frame = max(1, math.ceil(interval / wanted - 1e-9))
        self.dt = interval / self.steps_per_frame
        if self.steps_per_frame > MOST_STEPS and scene.frames > 0:
            raise SceneError(
                f"a frame of {interval:.3g} s would take {self.steps_per_frame:.3g} steps of {self.dt:.3g} s: raise "
                "fps, or take BackwardEuler with a longer dt"
            )
        if self.stepper.controls_error and scene.dt != "auto":
            raise SceneError(f'{type(self.solver).__name__} with an error target chooses dt: take dt="auto"')
        if scene.frames > 0:
            self.stepper.prepare(self.state, self.dt)
        self._observe(0)
        self._first = 0
        self._begun = False
        wanted_dt = interval if self.stepper.controls_error else None
        self.summary = Summary(self.dt, time.perf_counter() - start, self._rest_limit, wanted_dt)

    def restore(self, index: int, time: float, displacement: np.ndarray, velocity: np.ndarray) -> Frame:
        """Takes the state of an earlier run at a frame: :meth:`frames` then goes on with the next one.

        On the CPU the frames are the same as without the interruption, to the last bit, if :attr:`summary` has taken
        up the totals of the earlier run too: ``dt="auto"`` looks at the steps done, and at the limit seen last.

        Args:
            index: index of the frame.
            time: its time [s], as the earlier run counted it.
            displacement, velocity: (point_count, dim) [m] and [m/s].

        Returns:
            That frame.

        Raises:
            SimulationError: the arrays do not fit the scene.
        """
        self.state.assign(displacement=displacement, velocity=velocity)
        self.state.time = time
        self._first = index + 1
        return self._observe(index)

    def frames(self) -> Iterator[Frame]:
        """Runs the scene, once; yields the initial state and then one frame per frame interval.

        After :meth:`restore` the first one is that after the restored frame.

        Raises:
            SimulationError: the run cannot go on, or has been started before. The frames yielded so far are good.
        """
        summary = self.summary
        if self._begun:
            raise SimulationError("this simulation has been run: make another one to run the scene again")
        self._begun = True
        if self._first == 0:
            frame = self._observe(0)
            summary.add_frame(frame)
            yield frame
        for index in range(max(self._first, 1), self.scene.frames + 1):
            start = time.perf_counter()
            self._advance(index / self.scene.fps)
            wp.synchronize_device(self.model.device)
            summary.stepping_seconds += time.perf_counter() - start
            frame = self._observe(index)
            summary.add_frame(frame)
            if index == self.scene.frames and summary.smallest_jacobian <= 0.0:
                self._warn_of_folds(frame)
            yield frame

    def _advance(self, end: float) -> None:
        """Steps to the end of a frame."""
        if self._rest_limit is None and not self.stepper.controls_error:
            left = self.steps_per_frame
            while left:
                left -= self._take_steps(left)
            self.state.time = end  # without the rounding of many steps
            return
        while end - self.state.time > 1e-9 / self.scene.fps:
            self.step_towards(end)

    def step_towards(self, end: float) -> None:
        """Takes the next step, of the length that the scene asks for, but not beyond the time ``end`` [s]; or some of
        them, where steps of the same length are taken several at a time.

        Raises:
            SimulationError: the run cannot go on.
        """
        summary, interval, left = self.summary, 1.0 / self.scene.fps, end - self.state.time
        if self.stepper.controls_error:
            assert summary.wanted_dt is not None
            step = controlled_step(self.stepper, self.solver.order, self.state, left, summary.wanted_dt, interval)
            summary.wanted_dt = step.wanted
            summary.rejected_steps += step.rejected
            self._set_dt(step.dt)
            self._count(step.report)
            return
        if self._rest_limit is not None:
            if summary.steps % AUTO_INTERVAL == 0:
                self._follow_limit()
            assert summary.stable_dt is not None
            parts = math.ceil(left / (AUTO_FRACTION * summary.stable_dt) - 1e-9)
            if not math.isclose(left / parts, self.dt, rel_tol=SAME_DT):
                self._set_dt(left / parts)
            self._take_steps(min(parts, AUTO_INTERVAL - summary.steps % AUTO_INTERVAL))
            return
        self._take_steps(1)

    def _set_dt(self, dt: float) -> None:
        self.dt = self.summary.dt = dt
        self.steps_per_frame = math.ceil(1.0 / self.scene.fps / dt - 1e-9)

    def _follow_limit(self) -> None:
        """Estimates the stability limit again; it grows slowly, and never beyond that at rest."""
        summary, rest = self.summary, self._rest_limit
        here = self.stepper.estimate_stable_dt(self.state)
        assert rest is not None and summary.stable_dt is not None and here is not None
        summary.stable_dt = min(rest, here, 1.1 * summary.stable_dt)
        if not summary.stable_dt > LEAST_FRACTION * rest:
            raise TimeStepError(
                f"t = {self.state.time:.6g} s: the stability limit of explicit steps has fallen to "
                f"{summary.stable_dt:.3g} s, from {rest:.3g} s at the start: {worst_cell(self.model, self.state.u)}. "
                "Take BackwardEuler, or meshes and materials that are squashed less"
            )

    def _take_steps(self, most: int) -> int:
        """Takes at most so many steps of the current length; returns how many."""
        steps, report = self.stepper.advance(self.state, self.dt, most)
        self._count(report, steps)
        return steps

    def _count(self, report: StepReport, steps: int = 1) -> None:
        """Takes steps of the current length into account."""
        summary = self.summary
        summary.shortest_dt = min(self.dt, summary.shortest_dt or self.dt)
        summary.longest_dt = max(self.dt, summary.longest_dt)
        summary.steps += steps
        summary.simulated_seconds = self.state.time
        summary.newton_iterations += report.newton_iterations
        summary.cg_iterations += report.cg_iterations
        summary.divided_steps += report.parts > 1
        if report.note:
            summary.rounded_steps += report.converged
            summary.unconverged_steps += not report.converged
            if report.residual >= summary.worst_residual:
                summary.worst_residual, summary.worst_note = report.residual, report.note

    def _observe(self, index: int) -> Frame:
        frame = observe(self.model, self.state, index)
        self._warn_of_inverted_cells(frame.jacobian)
        return frame

    def _warn_of_folds(self, frame: Frame) -> None:
        """Warns of bodies that had inverted cells and ended with none, but folded into themselves."""
        rest = self.model.rest_points
        for body, (own, cells) in zip(self.scene.bodies, self.model.body_slices, strict=True):
            if (frame.jacobian[cells] <= 0.0).any():
                continue
            folded = folds(body.mesh, (rest + frame.displacement)[own])
            if len(folded):
                self.summary.folds += len(folded)
                where = "edges" if self.scene.dim == 3 else "points"
                warnings.warn(
                    f"body '{body.name}' has ended folded into itself: its cells turn twice about {len(folded)} of its "
                    f"inner {where} (the first: {'-'.join(map(str, folded[0]))}). It rests there, though it is not its "
                    "rest shape: start without inverted cells, or take shorter steps",
                    stacklevel=2,
                )

    def _warn_of_inverted_cells(self, jacobian: np.ndarray) -> None:
        """Warns, once for each body: the energies of most materials have other minima than the rest shape there."""
        for body, (_, cells) in zip(self.scene.bodies, self.model.body_slices, strict=True):
            inverted = np.flatnonzero(jacobian[cells] <= 0.0)
            if len(inverted) and body.name not in self._warned and not body.material.constitutive.convex:
                self._warned.add(body.name)
                kind = type(body.material).__name__
                warnings.warn(
                    f"t = {self.state.time:.6g} s: {len(inverted)} of {body.mesh.cell_count} cells of body "
                    f"'{body.name}' are inverted (the first is cell {inverted[0]}, J = "
                    f"{jacobian[cells][inverted[0]]:.4g}): "
                    + (
                        "the body may come to rest folded"
                        if body.material.resists_mirroring
                        else f"{kind} does not turn them back"
                    ),
                    stacklevel=2,
                )


def observe(model: Model, state: State, index: int) -> Frame:
    """What is recorded of a state.

    Raises:
        SimulationError: it is not finite.
    """
    require_finite(model, state.u, "the displacement", state.time)
    require_finite(model, state.v, "the velocity", state.time)
    displacement = state.displacement
    jacobian, von_mises = model.diagnostics(state)
    bad = ~np.isfinite(von_mises)
    if bad.any():
        first = int(np.argmax(bad))
        body, cell = model.body_of_cell(first)
        raise SimulationError(
            f"t = {state.time:.6g} s: the stress of cell {cell} of body '{body.name}' is not finite "
            f"({int(bad.sum())} cells in all; its J is {jacobian[first]:.4g}). A smaller dt, or a material that "
            "bears inversion (StableNeoHookean), may help"
        )
    return Frame(
        index=index,
        time=state.time,
        displacement=displacement,
        velocity=state.velocity,
        jacobian=jacobian,
        von_mises=von_mises,
        energies=model.energies(state),
        penetration=0.0 if model.contact is None else model.contact.depth(displacement),
    )
