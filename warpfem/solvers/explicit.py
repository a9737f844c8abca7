"""Explicit time integration: symplectic Euler and velocity Verlet."""

import functools
import math
from abc import abstractmethod
from collections.abc import Callable, Hashable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpfem.barrier import Barriers
from warpfem.dtypes import types
from warpfem.errors import SimulationError, TimeStepError
from warpfem.launches import Recordings, captured, jobs
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

TOGETHER = 32
"""Most steps that are launched as one graph: the detour through Python takes as long as the forces of some thousand
cells, and that of handing work to other threads as long as those of some ten thousand."""

BARRIERS = 5
"""Where threads wait for one another in a step: for what the calling thread does alone, and between the parts."""

RECORDING = 1_000_000
"""Cells, in all steps alike so far, for each step of a graph that is made: some twenty times the work of making it."""

LAUNCHING = 1000
"""Cells whose forces take as long as the launches of a step."""

ALARM_INTERVAL = 16
"""Steps after which a device other than the CPU is asked for alarms."""


KickDrift = Callable[[State, range, wp.array], wp.Launch | None]


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
        settings: wp.array(dtype=scalar),
        u_out: wp.array(dtype=vector),
        v_out: wp.array(dtype=vector),
        alarm_out: wp.array(dtype=wp.int32),
    ):
        """v = decay v + kick f / m, then u += drift v of some points; an alarm where |v| is not below a limit.

        These numbers are in an array, so that what has been recorded serves for steps of any length.
        """
        start = first + wp.tid() * points_per_task
        decay = settings[0]
        kick = settings[1]
        drift = settings[2]
        watched_speed = settings[3]
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
    """The forces of vectorised bodies, and the move of the points that follows, divided among threads.

    Each thread computes the forces of its cells and sums them for each point, but for points that threads have in
    common; once all are done, it adds the forces on those among its points, and moves its points. Which thread does
    what changes no bit of the result.
    """

    def __init__(self, model: Model, force: wp.array) -> None:
        self._model, self._force = model, force
        self._forces = [block.vectorized for block in model.blocks]
        self._points = share(model.point_count, model.team.size, CHUNK)
        self._barriers = Barriers(model.team, BARRIERS * TOGETHER) if model.team.size > 1 else None
        self._flushed = [SubnormalsFlushed() for _ in self._points]
        self._passed = 0  # barriers, in what is captured
        self._others: list[list[Job]] | None = None  # what is captured of threads other than the calling one
        self._recordings = Recordings()

    def run(self, kick_drift: KickDrift, state: State, settings: wp.array) -> None:
        """Takes the forces of the state, then moves the points.

        Args:
            kick_drift: what launches the move, :meth:`_ExplicitStepper._record_kick_drift`; not kept, because a stepper
                that its passes hold would stay with all its arrays until Python looks for cycles.
            state: the state.
            settings: of the move.
        """
        key = (state.u.ptr, state.v.ptr, settings.ptr)
        forces, moves = self._recordings.get(key, lambda: self._record(kick_drift, state, settings))
        if self._others is not None:
            self._divide(state, forces, moves)
            return
        self._model.external_force(state.u, self._force)
        if self._barriers is None:
            _run_all(launch.launch for launch in forces[0] + moves[0])
        else:
            parts = enumerate(zip(forces, moves, strict=True))
            launches = [[*first, self._barriers.record(0, thread), *then] for thread, (first, then) in parts]
            self._barriers.run(jobs(launches, SubnormalsFlushed, as_graphs=False))

    def _divide(self, state: State, forces: list[list[wp.Launch]], moves: list[list[wp.Launch]]) -> None:
        """The same in what is captured: launched by the calling thread as far as it is its part, listed for others."""
        model = self._model
        for thread, points in enumerate(self._points):
            waits = [self._barriers.record(self._passed + k, thread).launch for k in range(BARRIERS)]
            work = [waits[0], functools.partial(model.reset_force, self._force, points), waits[1]]
            if model.contact is not None:
                touch = functools.partial(model.contact.add_force, state.u, self._force)
                work += [waits[2]] if thread else [touch, waits[2]]
            work += [launch.launch for launch in forces[thread]]
            work += [waits[3], *(launch.launch for launch in moves[thread]), waits[4]]
            if thread == 0:
                _run_all(work)
            else:
                self._others[thread - 1] += work
        self._passed += BARRIERS

    def _record(
        self, kick_drift: KickDrift, state: State, settings: wp.array
    ) -> tuple[list[list[wp.Launch]], list[list[wp.Launch]]]:
        """The launches of each thread up to where all wait for one another, and those after."""
        forces = zip(*(force.record(state.u, self._force) for force in self._forces), strict=True)
        moves = (
            [*(force.record_aside(self._force, points) for force in self._forces), kick_drift(state, points, settings)]
            for points in self._points
        )
        first, second = ([[one for one in own if one is not None] for own in every] for every in (forces, moves))
        return first, second

    def capture(self, launch: Job) -> Job:
        """What does again what ``launch`` does, with all threads."""
        self._passed = 0
        if self._barriers is None:
            return captured(launch, self._flushed[0])
        self._others = [[] for _ in self._points[1:]]
        try:
            work = [captured(launch, self._flushed[0])]
            for own, flushed in zip(self._others, self._flushed[1:], strict=True):
                work.append(captured(functools.partial(_run_all, own), flushed))
        finally:
            self._others = None
        return functools.partial(self._barriers.run, work)


def _run_all(jobs: Iterable[Job]) -> None:
    for job in jobs:
        job()


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
        self._as_graph = model.device.is_cpu and (alone or self._passes is not None)
        self._launched: Hashable = None  # what the last step's launches were made for
        self._alike = 0  # steps since that is so
        self._graphs = Recordings()
        self._settings: dict[tuple[float, float], wp.array] = {}
        self._set_for: tuple[float, float] | None = None
        self._inverse_mass = self._free_inverse_mass()
        self._recordings = Recordings()

    def step(self, state: State, dt: float) -> StepReport:
        return self.advance(state, dt, 1)[1]

    def advance(self, state: State, dt: float, most: int) -> tuple[int, StepReport]:
        self._begin(state, dt)
        count = self._advance(state, dt, most)
        for _ in range(count):
            state.time += dt
        state.revision += count
        self._look(state, dt, count)
        return count, StepReport()

    def _advance(self, state: State, dt: float, most: int) -> int:
        """Launches steps, and returns how many: as a graph if the last one was alike, which costs bodies of a thousand
        cells a quarter of the time that launching one kernel after another takes, and several at a time still less."""
        self._set(dt)
        made_for = (state.u.ptr, state.v.ptr, dt if self._rough else None)
        if not self._as_graph or observing() or made_for != self._launched:
            self._launched, self._alike = made_for, 1
            with self._flushed:
                self._launch(state, dt)
            return 1
        count = self._together(most)
        self._alike += count
        self._graphs.get((*made_for, count), lambda: self._capture(state, dt, count))()
        return count

    def _together(self, most: int) -> int:
        """How many steps to take at a time: a power of two, so that a few graphs will do."""
        if self.model.supports is not None and self.model.supports.moving:
            return 1
        paid = self._alike * (self.model.cell_count + LAUNCHING) // RECORDING
        most = min(most, TOGETHER, self._interval - self._steps % self._interval, max(1, paid))
        return 1 << most.bit_length() - 1

    def _capture(self, state: State, dt: float, count: int) -> Job:
        def launch() -> None:
            for _ in range(count):
                self._launch(state, dt)

        return captured(launch, self._flushed) if self._passes is None else self._passes.capture(launch)

    def _set(self, dt: float) -> None:
        """Brings the settings of moves up to date."""
        if self._set_for != (dt, self._watched_speed):
            self._set_for = dt, self._watched_speed
            for (kick, drift), settings in self._settings.items():
                settings.assign([*self._impulse(kick * dt), drift * dt, self._watched_speed])

    def _settings_of(self, kick: float, drift: float) -> wp.array:
        """The settings of a move, in parts of dt: what is left of the velocity, kick, drift, and speed watched for."""
        if (kick, drift) not in self._settings:
            self._settings[kick, drift] = wp.zeros(4, dtype=self.model.types.scalar, device=self.model.device)
            dt, self._set_for = self._set_for[0], None
            self._set(dt)
        return self._settings[kick, drift]

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

    def _look(self, state: State, dt: float, count: int) -> None:
        """Now and then, and where points have become faster than ever, looks whether the run is still stable."""
        self._steps += count
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
        self._passes.run(self._record_kick_drift, state, self._settings_of(kick, drift))

    def _kick_drift(self, state: State, kick: float, drift: float) -> None:
        """Lets forces and damping act for a part of dt, as v' = f / m - alpha v has it, then moves for another."""
        points, settings = range(self.model.point_count), self._settings_of(kick, drift)
        key = (state.u.ptr, state.v.ptr, settings.ptr)
        self._recordings.get(key, lambda: self._record_kick_drift(state, points, settings)).launch()

    def _impulse(self, kick: float) -> tuple[float, float]:
        """What is left of the velocity after a time, and the time for which the force counts."""
        alpha = self.model.scene.damping
        if alpha == 0.0:
            return 1.0, kick
        return math.exp(-alpha * kick), -math.expm1(-alpha * kick) / alpha

    def _record_kick_drift(self, state: State, points: range, settings: wp.array) -> wp.Launch | None:
        per_task = CHUNK if self.model.device.is_cpu else 1  # a GPU has a thread for each
        return wp.launch(
            self._kernel,
            -(-len(points) // per_task),
            inputs=[points.start, points.stop, per_task, self._force, self._inverse_mass, settings],
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
            self._evaluate(state, 1.0, 0.0)
            self._rub(state, dt)
            self._kick_drift(state, 0.0, 1.0)
        else:
            self._evaluate(state, 1.0, 1.0)
        self._hold(state)


class _VelocityVerletStepper(_ExplicitStepper):
    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self._known: tuple[State, int] | None = None  # state and revision that the force belongs to

    def _advance(self, state: State, dt: float, most: int) -> int:
        if self._known is None or self._known[0] is not state or self._known[1] != state.revision:
            self._set(dt)
            with self._flushed:
                self._evaluate(state)
        count = super()._advance(state, dt, most)
        self._known = (state, state.revision + count)
        return count

    def _launch(self, state: State, dt: float) -> None:
        if self._rough:
            self._kick_drift(state, 0.5, 0.0)
            self._rub(state, 0.5 * dt)
            self._kick_drift(state, 0.0, 1.0)
        else:
            self._kick_drift(state, 0.5, 1.0)
        self._hold(state)
        self._evaluate(state, 0.5, 0.0)
        self._rub(state, 0.5 * dt)
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
