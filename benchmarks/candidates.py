"""Implicit schemes that ``time_integration.py`` measures beside those of warpfem, and that were not kept.

The trapezoidal rule, generalised-alpha and TR-BDF2 fail or gain energy from extreme starts; the first two are no more
accurate than the midpoint rule, which also keeps angular momentum. BDF2 needs the step before, and has more than the
error of SDIRK2 for the same iterations but on a rough floor. Crouzeix's scheme leaves fast motion undamped: it is slow
to come to rest.

They use warpfem's own solution of a step; damping and friction at the start of a step are left out.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpfem.model import Model, State
from warpfem.solvers.base import Stepper, StepReport
from warpfem.solvers.implicit import ImplicitSolver, ImplicitStepper, Tableau


class _CandidateStepper(ImplicitStepper):
    """Steps that are solved by :meth:`_solve_for`, with NumPy between the solutions."""

    def _acceleration(self, u: np.ndarray) -> np.ndarray:
        model, force = self.model, self.model.zeros()
        model.force(self._device(u), force)
        if model.supports is not None:
            model.supports.project(force)
        return force.numpy().astype(np.float64) / model.lumped_mass[:, None]

    def _device(self, vector: np.ndarray) -> wp.array:
        return wp.array(vector, dtype=self.model.types.vector, device=self.model.device)

    def _solve_for(
        self, state: State, time: float, base: np.ndarray, weight: float, predicted: np.ndarray, duration: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Minimises Phi; returns u and d."""
        model, newton = self.model, self.newton
        if model.supports is not None:
            model.supports.advance(time, 0.0)
        if model.contact is not None:
            model.contact.limit_friction(state.u)
        newton.potential.pose(self._device(base), weight, duration)
        newton.potential.predicted.assign(predicted)
        wp.copy(newton.u, state.u)
        report = newton.minimise(newton.start_in_flight(newton.start_where_it_is()), time)
        assert report.converged, report
        self.report = report if self.report is None else self.report + report
        return newton.u.numpy().astype(np.float64), newton.d.numpy().astype(np.float64)

    def _single_step(self, state: State, dt: float) -> StepReport:
        self.report: StepReport | None = None
        u, v = self.advance(state, dt)
        state.u.assign(u)
        state.v.assign(v)
        if self.model.supports is not None:
            self.model.supports.advance(state.time + dt, dt)
            self.model.supports.hold(state.u, state.v)
        state.time += dt
        state.revision += 1
        return self.report

    def advance(self, state: State, dt: float) -> tuple[np.ndarray, np.ndarray]:
        raise NotImplementedError


class _TrapezoidalStepper(_CandidateStepper):
    def advance(self, state, dt):
        u, v = state.displacement, state.velocity
        predicted = dt * v + 0.25 * dt**2 * self._acceleration(u)
        u, d = self._solve_for(state, state.time + dt, u, 4.0 / dt**2, predicted, dt)
        return u, 2.0 / dt * d - v


class _TrBdf2Stepper(_CandidateStepper):
    def advance(self, state, dt):
        gamma = 2.0 - 2.0**0.5
        u, v, h = state.displacement, state.velocity, gamma * dt
        predicted = h * v + 0.25 * h**2 * self._acceleration(u)
        u1, d = self._solve_for(state, state.time + h, u, 4.0 / h**2, predicted, h)
        v1 = 2.0 / h * d - v
        new, old = 1.0 / (gamma * (2.0 - gamma)), (1.0 - gamma) ** 2 / (gamma * (2.0 - gamma))
        h = (1.0 - gamma) / (2.0 - gamma) * dt
        u, d = self._solve_for(state, state.time + dt, new * u1 - old * u, 1.0 / h**2, h * (new * v1 - old * v), h)
        return u, d / h


class _Bdf2Stepper(_CandidateStepper):
    before: tuple[np.ndarray, np.ndarray, float] | None = None

    def advance(self, state, dt):
        u, v = state.displacement, state.velocity
        if self.before is None or state.time != self.before[2]:
            u1, d = self._solve_for(state, state.time + dt, u, 1.0 / dt**2, dt * v, dt)
            v1 = d / dt
        else:
            h = 2.0 / 3.0 * dt
            base, rate = (4.0 * u - self.before[0]) / 3.0, (4.0 * v - self.before[1]) / 3.0
            u1, d = self._solve_for(state, state.time + dt, base, 1.0 / h**2, h * rate, h)
            v1 = d / h
        self.before = u, v, state.time + dt
        return u1, v1


class _GeneralisedAlphaStepper(_CandidateStepper):
    before: tuple[np.ndarray, float] | None = None

    def advance(self, state, dt):
        rho = self.config.spectral_radius
        alpha_m, alpha_f = (2.0 * rho - 1.0) / (rho + 1.0), rho / (rho + 1.0)
        gamma, beta = 0.5 - alpha_m + alpha_f, 0.25 * (1.0 - alpha_m + alpha_f) ** 2
        u, v = state.displacement, state.velocity
        known = self.before is not None and self.before[1] == state.time
        a = self.before[0] if known else self._acceleration(u)
        # at the place (1 - alpha_f) u_1 + alpha_f u_0 = base + c a_1
        base = u + (1.0 - alpha_f) * (dt * v + (0.5 - beta) * dt**2 * a)
        c = (1.0 - alpha_f) * beta * dt**2
        predicted = -alpha_m * c / (1.0 - alpha_m) * a
        time = state.time + (1.0 - alpha_f) * dt
        _, d = self._solve_for(state, time, base, (1.0 - alpha_m) / c, predicted, (1.0 - alpha_f) * dt)
        a1 = d / c
        self.before = a1, state.time + dt
        return u + dt * v + dt**2 * ((0.5 - beta) * a + beta * a1), v + dt * ((1.0 - gamma) * a + gamma * a1)


@dataclass(frozen=True)
class _Candidate(ImplicitSolver):
    order = 2
    tableau = Tableau(rows=((1.0,),))


class Trapezoidal(_Candidate):
    """u and v by the trapezoidal rule."""

    name = "trapezoidal"

    def stepper(self, model: Model) -> Stepper:
        return _TrapezoidalStepper(model, self)


class TRBDF2(_Candidate):
    """A trapezoidal stage and one of BDF2 (Bank et al. 1985)."""

    name = "tr_bdf2"

    def stepper(self, model: Model) -> Stepper:
        return _TrBdf2Stepper(model, self)


class BDF2(_Candidate):
    """The two-step backward differentiation formula, started by backward Euler."""

    name = "bdf2"

    def stepper(self, model: Model) -> Stepper:
        return _Bdf2Stepper(model, self)


@dataclass(frozen=True)
class GeneralisedAlpha(_Candidate):
    """Chung and Hulbert 1993, the force at the mean place."""

    spectral_radius: float = 0.8

    name = "generalised_alpha"

    def stepper(self, model: Model) -> Stepper:
        return _GeneralisedAlphaStepper(model, self)


_C = 0.5 + 3.0**0.5 / 6.0


class Crouzeix(_Candidate):
    """Two stages, third order, A-stable (Crouzeix 1975)."""

    name = "crouzeix"
    order = 3
    tableau = Tableau(rows=((_C,), (1.0 - 2.0 * _C, _C)), weights=(0.5, 0.5))
