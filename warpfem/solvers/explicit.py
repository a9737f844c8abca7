"""Explicit time integration: symplectic Euler and velocity Verlet."""

import functools
import math
from abc import abstractmethod
from collections.abc import Callable, Hashable
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpfem.barrier import Barrier
from warpfem.dtypes import types
from warpfem.errors import SimulationError, TimeStepError
from warpfem.launches import Recordings, jobs
from warpfem.model import Model, State
from warpfem.points import CHUNK
from warpfem.profiling import observing
from warpfem.solvers.base import Solver, Stepper, StepReport, require_positive, worst_cell
from warpfem.solvers.stability import Watch, largest_frequency
from warpfem.subnormals import SubnormalsFlushed
from warpfem.threads import Job, share

TRACKING_INTERVALS = (16, 1024)
"""Bounds of the steps after which the stability limit is estimated again, at the cost of some five steps of linear
cells and some fifty of quadratic ones: the fewer cells, the sooner a wave has crossed them, the less it matters."""

VECTORIZED_CELLS = 1024
"""Cells of a material, quadratic ones counted by their quadrature points, from which on its forces are computed several
cells at a time: that takes some seconds to compile once, and work to prepare."""

ALARM_INTERVAL = 16
"""Steps after which a device other than the CPU is asked for alarms."""


KickDrift = Callable[..., wp.Launch | None]


@functools.cache
def _kick_drift_kernel(dim: int, dtype: str) -> wp.Kernel:
    t = types(dim, dtype)
    vector, scalar = t.vector, t.scalar

    @wp.kernel(module="unique", enable_backward=False)
    def kick_drift(
        first: int,
        last: int,
        points_per_task: int,
        force: wp.array(dtype=vector),
        inverse_mass: wp.array(dtype=scalar),
        decay: scalar,
        kick: scalar,
        drift: scalar,
        watched_speed: scalar,
        u_out: wp.array(dtype=vector),
        v_out: wp.array(dtype=vector),
        alarm_out: wp.array(dtype=wp.int32),
    ):
        """v = decay v + kick f / m, then u += drift v of some points; an alarm where |v| is not below a limit."""
        start = first + wp.tid() * points_per_task
        forces = wp.array(ptr=force.ptr, shape=(0,), dtype=vector)  # views with a stride known at compile time, which
        inverse = wp.array(ptr=inverse_mass.ptr, shape=(0,), dtype=scalar)  # spare a multiplication at each access
        u = wp.array(ptr=u_out.ptr, shape=(0,), dtype=vector)
        v = wp.array(ptr=v_out.ptr, shape=(0,), dtype=vector)
        slow = int(1)
        for i in range(start, wp.min(start + points_per_task, last)):
            velocity = decay * v[i] + (kick * inverse[i]) * forces[i]
            v[i] = velocity
            u[i] = u[i] + drift * velocity
            slow = wp.min(slow, wp.where(wp.length_sq(velocity) <= watched_speed * watched_speed, 1, 0))
        if slow == 0:
            alarm_out[0] = 1

    return kick_drift


class _Passes:
    """A step of vectorised bodies as two passes of recorded launches, each divided among threads.

    The first computes the forces of the cells and sums them for each point, but for points that threads have in common;
    the second adds the forces on those, and moves the points. In between, the threads wait for one another. Which
    thread does what changes no bit of the result.
    """

    def __init__(self, model: Model, force: wp.array) -> None:
        self._forces = [block.vectorized for block in model.blocks]
        self._force = force
        self._team = model.team
        self._barrier = Barrier(self._team) if self._team.size > 1 else None
        self._points = share(model.point_count, self._team.size, CHUNK)
        self._recordings, self._steps = Recordings(), Recordings()

    def run(self, kick_drift: KickDrift, state: State, *settings: float) -> None:
        """Takes the step.

        Args:
            kick_drift: what launches the move, :meth:`_ExplicitStepper._record_kick_drift`; not kept, because a stepper
                that its passes hold would stay with all its arrays until Python looks for cycles.
            state: the state.
            settings: of the move.
        """
        key = (state.u.ptr, state.v.ptr, *settings)
        work = self._steps.get(key, lambda: self._record(kick_drift, state, *settings))
        (self._team if self._barrier is None else self._barrier).run(work)

    def _record(self, kick_drift: KickDrift, state: State, *settings: float) -> list[Job]:
        forces = self._recordings.get((state.u.ptr,), lambda: self._record_forces(state.u))
        moves = [[kick_drift(state, points, *settings)] for points in self._points]
        pairs = zip(forces, jobs(moves, SubnormalsFlushed, as_graphs=False), strict=True)
        return [functools.partial(_in_turn, *pair) for pair in pairs]

    def _record_forces(self, u: wp.array) -> list[Job]:
        launches: list[list[wp.Launch | None]] = [[] for _ in self._points]
        for force in self._forces:
            for all_own, own in zip(launches, force.record(u, self._force), strict=True):
                all_own.append(own)
        if self._barrier is not None:
            for own, points in zip(launches, self._points, strict=True):
                own.append(self._barrier.record())
                own.extend(force.record_aside(self._force, points) for force in self._forces)
        return jobs(launches, SubnormalsFlushed, as_graphs=self._team.size > 1)  # else the whole step is one


def _in_turn(first: Job, second: Job) -> None:
    first()
    second()


class _ExplicitStepper(Stepper):
    def __init__(self, model: Model) -> None:
        self.model = model
        model.vectorize(VECTORIZED_CELLS)
        self._kernel = _kick_drift_kernel(model.dim, model.dtype)
        self._force = model.zeros()
        self._rough = model.contact is not None and model.contact.rough
        self._rest_frequency: float | None = None
        self._limit: float | None = None
        self._watch: Watch | None = None
        self._watched_speed = 0.0
        self._seen: tuple[State, int] | None = None  # state and revision that the watch has followed
        self._alarm = wp.zeros(1, dtype=wp.int32, device=model.device)
        self._alarm_on_host = self._alarm.numpy() if model.device.is_cpu else None  # making the view costs a launch
        self._steps = 0
        self._interval = int(np.clip(model.cell_count // 16, *TRACKING_INTERVALS))
        self._passes: _Passes | None = None
        if all(block.vectorized for block in model.blocks):
            self._passes = _Passes(model, self._force)
        self._flushed = SubnormalsFlushed() if model.device.is_cpu else nullcontext()
        alone = model.team.size == 1 or not any(block.vectorized for block in model.blocks)
        self._as_graph = model.device.is_cpu and alone
        self._launched: Hashable = None  # what the last step's launches were made for
        self._graphs = Recordings()
        self._inverse_mass = self._free_inverse_mass()
        self._recordings = Recordings()

    def step(self, state: State, dt: float) -> StepReport:
        self._begin(state, dt)
        self._advance(state, dt)
        state.time += dt
        state.revision += 1
        self._look(state, dt)
        return StepReport()

    def _advance(self, state: State, dt: float) -> None:
        """Launches the step; on one thread as a graph if the last one was the same, which costs bodies of a thousand
        cells a quarter of the time that launching one kernel after another takes."""
        made_for = (state.u.ptr, state.v.ptr, dt, self._watched_speed)
        if not self._as_graph or observing() or made_for != self._launched:
            self._launched = made_for
            with self._flushed:
                self._launch(state, dt)
        else:
            wp.capture_launch(self._graphs.get(made_for, lambda: self._capture(state, dt)))

    def _capture(self, state: State, dt: float) -> wp.Graph:
        with wp.ScopedCapture(device=self.model.device) as capture, self._flushed:
            self._launch(state, dt)
        return capture.graph

    @abstractmethod
    def _launch(self, state: State, dt: float) -> None:
        """Launches all that moves the points over a step."""

    def _free_inverse_mass(self) -> wp.array:
        """1/m of each point, 0 where it is held: reactions must not look as if points had become fast."""
        model = self.model
        if model.supports is None:
            return model.inverse_mass
        inverse = model.inverse_mass.numpy().copy()
        held = model.supports.held.numpy().reshape(model.supports.count, -1).all(axis=1)
        inverse[model.supports.points.numpy()[held]] = 0.0
        return wp.array(inverse, dtype=model.types.scalar, device=model.device)

    def arrays(self) -> list[wp.array]:
        own = [self._force, self._alarm, *([] if self._watch is None else self._watch.arrays())]
        return own if self.model.supports is None else [*own, self._inverse_mass]

    def stable_dt(self, state: State | None = None) -> float:
        if self._rest_frequency is None:
            self._rest_frequency = largest_frequency(self.model)
        frequency = self._rest_frequency
        if state is not None and state.u.numpy().any():
            frequency = np.maximum(frequency, largest_frequency(self.model, state.u))  # not a number stays
        if state is not None and not np.isfinite(frequency):
            raise SimulationError(
                f"t = {state.time:.6g} s: the stiffness of the state is not finite; "
                f"{worst_cell(self.model, state.u)}. Start from a state with J > 0, or take StableNeoHookean"
            )
        return 2.0 / frequency if frequency > 0.0 else np.inf

    def estimate_stable_dt(self, state: State) -> float:
        if self._watch is None:
            self._watch, self._seen = Watch(self.model, state), (state, state.revision)
        return self._watch.stable_dt(state.u)

    def prepare(self, state: State, dt: float) -> None:
        super().prepare(state, dt)
        self._watch, self._steps = None, 0

    def _check_dt(self, state: State, dt: float) -> None:
        require_positive(dt)
        if self._limit is None:  # of the first state, also where a run is taken up in the middle
            self._limit = self.stable_dt(self.model.state())
        if self._watch is None or self._seen != (state, state.revision):
            self._watch = Watch(self.model, state)
            self._watched_speed = 0.0
        if dt > self._limit:
            raise TimeStepError(
                f"dt = {dt:.4g} s is above the stability limit of explicit steps in this scene, "
                f'{self._limit:.4g} s: take a smaller dt, dt="auto", or BackwardEuler'
            )

    def _look(self, state: State, dt: float) -> None:
        """Now and then, and where points have become faster than ever, looks whether the run is still stable."""
        self._steps += 1
        self._seen = (state, state.revision)
        if self._alarmed():
            self._alarm.zero_()
            self._watch.require_bounded(state, dt, self.adaptive)
            self._watched_speed = 2.0 * float(np.linalg.norm(state.velocity, axis=1).max())
        elif self._steps % self._interval:
            return
        if self.adaptive:
            return
        limit = self._watch.is_unstable(state, dt)
        if limit is not None:
            raise TimeStepError(
                f"t = {state.time:.6g} s: dt = {dt:.4g} s is above the stability limit of the deformed bodies, "
                f'{limit:.4g} s: take a smaller dt, dt="auto", or BackwardEuler'
            )

    def _alarmed(self) -> bool:
        """Whether a point has become faster than ever; off the CPU, where reading waits, that is asked now and then."""
        if self._alarm_on_host is not None:
            return bool(self._alarm_on_host[0])
        return self._steps % ALARM_INTERVAL == 0 and bool(self._alarm.numpy()[0])

    def _evaluate(self, state: State, kick: float = 0.0, drift: float = 0.0) -> None:
        """Takes the forces of the state, then as :meth:`_kick_drift`."""
        if self._passes is None:
            self.model.force(state.u, self._force)
            if kick or drift:
                self._kick_drift(state, kick, drift)
            return
        self.model.external_force(state.u, self._force)
        self._passes.run(self._record_kick_drift, state, *self._impulse(kick), drift, self._watched_speed)

    def _kick_drift(self, state: State, kick: float, drift: float) -> None:
        """Lets forces and damping act for a time, as v' = f / m - alpha v has it, then moves for another."""
        points, settings = range(self.model.point_count), (*self._impulse(kick), drift, self._watched_speed)
        key = (state.u.ptr, state.v.ptr, *settings)
        self._recordings.get(key, lambda: self._record_kick_drift(state, points, *settings)).launch()

    def _impulse(self, kick: float) -> tuple[float, float]:
        """What is left of the velocity after a time, and the time for which the force counts."""
        alpha = self.model.scene.damping
        if alpha == 0.0:
            return 1.0, kick
        return math.exp(-alpha * kick), -math.expm1(-alpha * kick) / alpha

    def _record_kick_drift(
        self, state: State, points: range, decay: float, kick: float, drift: float, speed: float
    ) -> wp.Launch | None:
        per_task = CHUNK if self.model.device.is_cpu else 1  # a GPU has a thread for each
        return wp.launch(
            self._kernel,
            -(-len(points) // per_task),
            inputs=[
                points.start,
                points.stop,
                per_task,
                self._force,
                self._inverse_mass,
                decay,
                kick,
                drift,
                speed,
            ],
            outputs=[state.u, state.v, self._alarm],
            device=self.model.device,
            record_cmd=True,
        )

    def _hold(self, state: State) -> None:
        supports = self.model.supports
        if supports is not None:
            key = (state.u.ptr, state.v.ptr)
            self._recordings.get(key, lambda: supports.record_hold(state.u, state.v)).launch()

    def _begin(self, state: State, dt: float) -> None:
        self._check_dt(state, dt)
        if self.model.supports is not None:
            self.model.supports.advance(state.time + dt, dt)

    def _rub(self, state: State, dt: float) -> None:
        if self._rough:
            self.model.contact.apply_friction_impulse(state.u, self.model.inverse_mass, dt, state.v)


class _SymplecticEulerStepper(_ExplicitStepper):
    def _launch(self, state: State, dt: float) -> None:
        if self._rough:  # friction acts between the new velocity and the drift
            self._evaluate(state, dt, 0.0)
            self._rub(state, dt)
            self._kick_drift(state, 0.0, dt)
        else:
            self._evaluate(state, dt, dt)
        self._hold(state)


class _VelocityVerletStepper(_ExplicitStepper):
    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self._known: tuple[State, int] | None = None  # state and revision that the force belongs to

    def _advance(self, state: State, dt: float) -> None:
        if self._known is None or self._known[0] is not state or self._known[1] != state.revision:
            with self._flushed:
                self._evaluate(state)
        super()._advance(state, dt)
        self._known = (state, state.revision + 1)

    def _launch(self, state: State, dt: float) -> None:
        half = 0.5 * dt
        if self._rough:
            self._kick_drift(state, half, 0.0)
            self._rub(state, half)
            self._kick_drift(state, 0.0, dt)
        else:
            self._kick_drift(state, half, dt)
        self._hold(state)
        self._evaluate(state, half, 0.0)
        self._rub(state, half)
        self._hold(state)


@dataclass(frozen=True)
class SymplecticEuler(Solver):
    """v += dt f(u) / m, then u += dt v (Hu 2020): one force a step, stable for dt < 2 / omega_max.

    Mass-proportional damping acts with the force, as v' = f / m - alpha v has it for a force that stays.
    """

    name = "symplectic_euler"
    order = 1

    def stepper(self, model: Model) -> Stepper:
        return _SymplecticEulerStepper(model)


@dataclass(frozen=True)
class VelocityVerlet(Solver):
    """Half a kick, a drift, half a kick: one force a step, stable for dt < 2 / omega_max, second order.

    Mass-proportional damping acts in both kicks, which keeps the order. Prescribed motions
    enter by the mean velocity of each step.
    """

    name = "velocity_verlet"
    order = 2

    def stepper(self, model: Model) -> Stepper:
        return _VelocityVerletStepper(model)
