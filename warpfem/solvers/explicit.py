"""Explicit time integration: symplectic Euler and velocity Verlet."""

import functools
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpfem.dtypes import types
from warpfem.errors import SimulationError, TimeStepError
from warpfem.model import Model, State
from warpfem.solvers.base import Solver, Stepper, StepReport, require_positive, worst_cell


@functools.cache
def _kick_drift_kernel(dim: int, dtype: str) -> wp.Kernel:
    t = types(dim, dtype)
    vector, scalar = t.vector, t.scalar

    @wp.kernel(module="unique", enable_backward=False)
    def kick_drift(
        force: wp.array(dtype=vector),
        inverse_mass: wp.array(dtype=scalar),
        decay_before: scalar,
        kick: scalar,
        decay_after: scalar,
        drift: scalar,
        u_out: wp.array(dtype=vector),
        v_out: wp.array(dtype=vector),
    ):
        """v = decay_after (decay_before v + kick f / m), then u += drift v."""
        i = wp.tid()
        v = decay_after * (decay_before * v_out[i] + (kick * inverse_mass[i]) * force[i])
        v_out[i] = v
        u_out[i] += drift * v

    return kick_drift


def largest_frequency(model: Model, u: wp.array | None = None) -> float:
    """An upper bound of the largest angular frequency [rad/s] of the model about ``u`` (default: at rest).

    The largest eigenvalue of the cells' own (K_e, M_e) bounds that of the assembled pair (Irons and Treharne
    1971). It is bounded in turn by (tr A^8)^(1/8), A = M_e^-1/2 K_e M_e^-1/2, which exceeds it by at most
    (rank A)^(1/8): at rest 1.25 for tetrahedra and 1.15 for triangles, and so dt by at most 12 % and 7 %. Contact adds
    the largest ratio of its stiffness to a point's mass.
    """
    corners = model.dim + 1
    largest = 0.0
    density = np.concatenate([np.broadcast_to(body.density, body.mesh.cell_count) for body in model.scene.bodies])
    for block, part, stiffness in model.element_stiffness_parts(u):
        volume = block.arguments[2].numpy()[part].astype(np.float64)
        mass = density[block.index[part]] * volume / corners
        A = stiffness.reshape(len(mass), corners * model.dim, -1) / mass[:, None, None]
        scale = np.linalg.norm(A, axis=(1, 2))
        A = A / np.where(scale > 0.0, scale, 1.0)[:, None, None]
        A = A @ A
        A = A @ A
        bound = scale * np.linalg.norm(A, axis=(1, 2)) ** 0.25
        largest = np.maximum(largest, bound.max())  # not a number stays
    if model.contact is not None:
        largest += model.contact.largest_stiffness_over_mass(model.host_mass)
    return float(np.sqrt(largest))


class _ExplicitStepper(Stepper):
    def __init__(self, model: Model) -> None:
        self.model = model
        self._kernel = _kick_drift_kernel(model.dim, model.dtype)
        self._force = model.zeros()
        self._rough = model.contact is not None and model.contact.rough
        self._limit: float | None = None

    def arrays(self) -> list[wp.array]:
        return [self._force]

    def stable_dt(self, state: State | None = None) -> float:
        limit = 2.0 / largest_frequency(self.model)
        if state is None:
            return limit
        here = 2.0 / largest_frequency(self.model, state.u)
        if not np.isfinite(here):
            raise SimulationError(
                f"t = {state.time:.6g} s: the stiffness of the state is not finite; "
                f"{worst_cell(self.model, state.u)}. Start from a state with J > 0, or take StableNeoHookean"
            )
        return min(limit, here)

    def _check_dt(self, state: State, dt: float) -> None:
        require_positive(dt)
        if self._limit is None:
            self._limit = self.stable_dt(state)
        if dt > self._limit:
            raise TimeStepError(
                f"dt = {dt:.4g} s is above the stability limit of explicit steps in this scene, "
                f'{self._limit:.4g} s: take a smaller dt, dt="auto", or BackwardEuler'
            )

    def _kick_drift(
        self, state: State, kick: float, drift: float, decay_before: float = 1.0, decay_after: float = 1.0
    ) -> None:
        model = self.model
        wp.launch(
            self._kernel,
            model.point_count,
            inputs=[self._force, model.inverse_mass, decay_before, kick, decay_after, drift],
            outputs=[state.u, state.v],
            device=model.device,
        )

    def _hold(self, state: State) -> None:
        if self.model.supports is not None:
            self.model.supports.hold(state.u, state.v)

    def _begin(self, state: State, dt: float) -> None:
        self._check_dt(state, dt)
        if self.model.supports is not None:
            self.model.supports.advance(state.time + dt, dt)

    def _rub(self, state: State, dt: float) -> None:
        if self._rough:
            self.model.contact.apply_friction_impulse(state.u, self.model.inverse_mass, dt, state.v)


class _SymplecticEulerStepper(_ExplicitStepper):
    def step(self, state: State, dt: float) -> StepReport:
        self._begin(state, dt)
        self.model.force(state.u, self._force)
        decay = float(np.exp(-self.model.scene.damping * dt))
        if self._rough:  # friction acts between the new velocity and the drift
            self._kick_drift(state, dt, 0.0, decay_before=decay)
            self._rub(state, dt)
            self._kick_drift(state, 0.0, dt)
        else:
            self._kick_drift(state, dt, dt, decay_before=decay)
        self._hold(state)
        state.time += dt
        state.revision += 1
        return StepReport()


class _VelocityVerletStepper(_ExplicitStepper):
    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self._known: tuple[State, int] | None = None  # state and revision that the force belongs to

    def step(self, state: State, dt: float) -> StepReport:
        self._begin(state, dt)
        if self._known is None or self._known[0] is not state or self._known[1] != state.revision:
            self.model.force(state.u, self._force)
        decay = float(np.exp(-0.5 * self.model.scene.damping * dt))
        half = 0.5 * dt
        if self._rough:
            self._kick_drift(state, half, 0.0, decay_before=decay)
            self._rub(state, half)
            self._kick_drift(state, 0.0, dt)
        else:
            self._kick_drift(state, half, dt, decay_before=decay)
        self._hold(state)
        self.model.force(state.u, self._force)
        self._kick_drift(state, half, 0.0, decay_after=decay)
        self._rub(state, half)
        self._hold(state)
        state.time += dt
        state.revision += 1
        self._known = (state, state.revision)
        return StepReport()


@dataclass(frozen=True)
class SymplecticEuler(Solver):
    """v += dt f(u) / m, then u += dt v (Hu 2020): one force a step, stable for dt < 2 / omega_max.

    Mass-proportional damping is the exact decay exp(-alpha dt) of the velocity.
    """

    name = "symplectic_euler"
    order = 1

    def stepper(self, model: Model) -> Stepper:
        return _SymplecticEulerStepper(model)


@dataclass(frozen=True)
class VelocityVerlet(Solver):
    """Half a kick, a drift, half a kick: one force a step, stable for dt < 2 / omega_max, second order.

    Mass-proportional damping is split symmetrically (Strang), which keeps the order. Prescribed motions
    enter by the mean velocity of each step.
    """

    name = "velocity_verlet"
    order = 2

    def stepper(self, model: Model) -> Stepper:
        return _VelocityVerletStepper(model)
