"""Implicit time integration: diagonally implicit Runge-Kutta schemes, each stage of which is a step of backward Euler.

For u' = v, M v' = f(u) - alpha M v a stage with the coefficients a_ij solves

    u_i = u_b + h v_i,  M v_i = M v_b + h (f(u_i) - alpha M v_i),  h = a_ii dt,
    u_b = u_t + dt sum_j<i a_ij v_j,  v_b = v_t + dt sum_j<i a_ij a_j,  a_j = (v_j - v_b,j) / h:

backward Euler of length h from u_b and v_b, which minimises the incremental potential with w = (1 + alpha h) / h^2
and d~ = h v_b / (1 + alpha h). Friction is that of the stage's velocity.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import factorial
from typing import ClassVar, Literal

import numpy as np
import warp as wp

from warpfem.errors import SimulationError
from warpfem.model import Model, State
from warpfem.solvers.base import (
    Solver,
    Stepper,
    StepReport,
    require_count,
    require_finite,
    require_positive,
    worst_cell,
)
from warpfem.solvers.error_control import ErrorNorm
from warpfem.solvers.newton import Newton, NewtonSettings, require_choice

VECTORIZED_CELLS = 8192
"""Cells of a material from which on its forces are computed several cells at a time, which takes some seconds to
compile once: the forces are a small part of an implicit step."""

CROSSING = "a point goes round or through a sphere or box, which more stiffness of the obstacle may prevent"

MAX_HALVINGS = 10
"""How often a step that fails is halved before it is refused."""


@dataclass(frozen=True)
class Tableau:
    """The coefficients of a diagonally implicit Runge-Kutta scheme.

    Attributes:
        rows: a_ij of each stage, up to its own a_ii > 0.
        weights: b_j, with which the step ends; ``None`` for those of the last stage, whose state is then the end.
    """

    rows: tuple[tuple[float, ...], ...]
    weights: tuple[float, ...] | None = None

    @cached_property
    def error_weights(self) -> tuple[float, ...]:
        """e_0 for v_t and e_j for each stage: dt times the sum of e_j v_j estimates the error of the displacements.

        It is how the scheme differs from the quadrature of these s + 1 velocities that is exact to order s + 1 for
        linear motion: sum_j b_j (A^k 1)_j = 1 / (k + 1)! for k = 0..s, where node 0 is the start of the step.
        """
        count = len(self.rows) + 1
        A = np.zeros((count, count))
        for index, row in enumerate(self.rows, start=1):
            A[index, 1 : index + 1] = row
        powers = [np.linalg.matrix_power(A, k).sum(axis=1) for k in range(count)]
        higher = np.linalg.solve(powers, [1.0 / factorial(k + 1) for k in range(count)])
        return tuple(higher - (A[-1] if self.weights is None else (0.0, *self.weights)))


@dataclass(frozen=True)
class ImplicitSolver(NewtonSettings, Solver):
    """Settings of all implicit schemes.

    Attributes:
        unconverged: what becomes of a step that misses the tolerance, unless rounding hides the rest: "halve"
            does it again in two halves, and so on ``MAX_HALVINGS`` times, then raises a SimulationError and leaves
            the state as it was; "accept" keeps what was reached and reports it.
    """

    unconverged: Literal["halve", "accept"] = "halve"

    tableau: ClassVar[Tableau]
    least_iterations: ClassVar[int] = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        require_count(self, "max_iterations", self.least_iterations)
        require_choice(self, "unconverged", ("halve", "accept"))

    def stepper(self, model: Model) -> Stepper:
        return ImplicitStepper(model, self)


class ImplicitStepper(Stepper):
    """Steps by a tableau, in parts where a step fails.

    Args:
        model: the model.
        config: the scheme and its settings.
        error: what a second of simulated time may add to the error of the displacements, relative to the body's size
            [1/s]; ``None`` estimates no errors.
    """

    def __init__(self, model: Model, config: ImplicitSolver, error: float | None = None) -> None:
        self.model = model
        self.config = config
        model.vectorize(VECTORIZED_CELLS)
        self.newton = Newton(model, config)
        tableau = config.tableau
        self._ends_with_stage = tableau.weights is None
        kept = len(tableau.rows) - self._ends_with_stage
        self._rates = [(model.zeros(), model.zeros()) for _ in range(kept)]  # v_j and a_j of the stages
        self._base = (model.zeros(), model.zeros()) if len(tableau.rows) > 1 else None
        self._end = None if self._ends_with_stage else model.zeros()
        self.error = error
        self.controls_error = error is not None
        self._norm = ErrorNorm(model) if self.controls_error else None

    @property
    def linear_solver(self) -> str:
        threads = self.model.team.size
        divided = f"; the matrix on {threads} threads" if self.newton.potential.operator.divided else ""
        return f"{self.newton.linear}{divided}"

    def arrays(self) -> list[wp.array]:
        own = [array for pair in self._rates for array in pair]
        own += [*(self._base or ()), *([] if self._end is None else [self._end])]
        own += [] if self._norm is None else self._norm.arrays()
        return [*own, *self.newton.arrays()]

    def prepare(self, state: State, dt: float) -> None:
        super().prepare(state, dt)
        self.newton.prepare()

    def step(self, state: State, dt: float) -> StepReport:
        require_positive(dt)
        self.attempt = None
        try:
            return self._single_step(state, dt)
        except SimulationError as failure:
            hopeless = not np.isfinite(self.model.energies(state).total)
            if self.config.unconverged == "accept" or hopeless:
                raise
            return self._step_in_parts(state, dt, failure)

    def try_step(self, state: State, dt: float) -> StepReport:
        require_positive(dt)
        self.attempt = None
        try:
            return self._single_step(state, dt, most_error=1.0)
        except SimulationError:
            self.attempt = self.newton.u
            raise

    def _step_in_parts(self, state: State, dt: float, failure: SimulationError) -> StepReport:
        """Two steps of half the length, and so on where one fails; puts the state back if the last one does."""
        start = state.copy()
        lengths = [0.5 * dt, 0.5 * dt]
        report: StepReport | None = None
        while lengths:
            try:
                part = self._single_step(state, lengths[-1])
            except BaseException as error:
                if not isinstance(error, SimulationError) or lengths[-1] < 1.5 * dt / 2**MAX_HALVINGS:
                    self.attempt = self.newton.u
                    wp.copy(state.u, start.u)
                    wp.copy(state.v, start.v)
                    state.time = start.time
                    state.revision += 1
                    if not isinstance(error, SimulationError):  # of a motion that a user wrote, or Ctrl-C
                        raise
                    raise SimulationError(
                        f"t = {start.time:.6g} s: the step of {dt:.4g} s cannot be solved, nor in parts of "
                        f"{lengths[-1]:.3g} s: {error}"
                    ) from failure
                lengths += [0.5 * lengths.pop()] * 2
                continue
            lengths.pop()
            report = part if report is None else report + part
        state.time = start.time + dt
        return report

    def _single_step(self, state: State, dt: float, most_error: float = np.inf) -> StepReport:
        """One step, by which ``state`` changes only if it succeeds, with no more than the error allowed.

        Raises:
            SimulationError: it does not.
        """
        model, newton, tableau = self.model, self.newton, self.config.tableau
        report: StepReport | None = None
        newton.linear.forget()
        if model.contact is not None:
            model.contact.limit_friction(state.u)
        for index, row in enumerate(tableau.rows):
            h = row[-1] * dt
            base_u, base_v = self._stage_base(state, dt, row)
            acceleration = self._rates[index - 1][1] if index else None
            stage = self._stage(state, base_u, base_v, acceleration, state.time + sum(row) * dt, h, dt)
            self._require_solved(stage)
            report = stage if report is None else replace(report + stage, parts=1)
            if index < len(self._rates):
                velocity, acceleration = self._rates[index]
                self._scale(1.0 / h, newton.d, velocity)
                self._scale(1.0 / h, velocity, acceleration)
                newton.potential.add_scaled(acceleration, -1.0 / h, base_v, acceleration)
        assert report is not None
        return self._finish(state, dt, h, report, most_error)

    def _stage_base(self, state: State, dt: float, row: tuple[float, ...]) -> tuple[wp.array, wp.array]:
        """u_b and v_b."""
        u, v = state.u, state.v
        if len(row) > 1:
            for coefficient, (velocity, acceleration) in zip(row[:-1], self._rates, strict=False):
                self.newton.potential.add_scaled(u, coefficient * dt, velocity, self._base[0])
                self.newton.potential.add_scaled(v, coefficient * dt, acceleration, self._base[1])
                u, v = self._base
        return u, v

    def _stage(
        self,
        state: State,
        base_u: wp.array,
        base_v: wp.array,
        acceleration: wp.array | None,
        time: float,
        h: float,
        dt: float,
    ) -> StepReport:
        """Solves a stage of length ``h`` from ``base_u`` and ``base_v``, which ends at ``time``.

        ``acceleration`` is that of the stage before.
        """
        model, potential = self.model, self.newton.potential
        damping = model.scene.damping
        potential.pose(base_u, (1.0 + damping * h) / h**2, h)
        self._scale(h / (1.0 + damping * h), base_v, potential.predicted)
        if model.supports is not None:
            model.supports.advance(time, dt)
        return self._solve(state, acceleration, time)

    def _solve(self, state: State, acceleration: wp.array | None, time: float) -> StepReport:
        newton = self.newton
        standing = newton.start_at_base() if acceleration is None else newton.start_where_it_is()
        value = newton.start_in_flight(standing, acceleration)
        if not np.isfinite(value):
            require_finite(self.model, state.u, "the displacement", state.time)
            require_finite(self.model, state.v, "the velocity", state.time)
        return newton.minimise(value, time)

    def _finish(self, state: State, dt: float, h: float, report: StepReport, most_error: float) -> StepReport:
        """Puts the state at the end of the step, of which the last stage was ``h`` long, if that is good."""
        model, potential = self.model, self.newton.potential
        u, way = self.newton.u, self.newton.d
        if self._end is not None:
            u = self._end
            wp.copy(u, state.u)
            for weight, (velocity, _) in zip(self.config.tableau.weights, self._rates, strict=True):
                potential.add_scaled(u, weight * dt, velocity, u)
            if model.supports is not None:
                model.supports.advance(state.time + dt, dt)
                model.supports.hold(u, potential.part)
            self._require_uninverted(u)
        if potential.base is not state.u or self._end is not None:
            way = potential.predicted
            potential.add_scaled(u, -1.0, state.u, way)
        if potential.crosses_an_obstacle(state.u, way):
            report = replace(report, converged=False, rounded=False, note=CROSSING)
            self._require_solved(report)
        if self._norm is not None:
            report = replace(report, error=self._estimate_error(state, dt, h))
            if not report.error <= most_error:
                return report
        if self._end is None:
            self._scale(1.0 / h, self.newton.d, state.v)
        else:
            for weight, (_, acceleration) in zip(self.config.tableau.weights, self._rates, strict=True):
                potential.add_scaled(state.v, weight * dt, acceleration, state.v)
        wp.copy(state.u, u)
        if model.supports is not None:
            model.supports.hold(state.u, state.v)
        state.time += dt
        state.revision += 1
        return report

    def _estimate_error(self, state: State, dt: float, h: float) -> float:
        """The estimate of the step's error over what the target allows for ``dt``."""
        potential, error = self.newton.potential, self.newton.potential.part
        first, *others, last = self.config.tableau.error_weights
        self._scale(first * dt, state.v, error)
        for weight, (velocity, _) in zip(others, self._rates, strict=True):
            potential.add_scaled(error, weight * dt, velocity, error)
        potential.add_scaled(error, last * dt / h, self.newton.d, error)
        if self.model.supports is not None:
            self.model.supports.project(error)
        return self._norm(error) / (self.error * dt)

    def _require_solved(self, report: StepReport) -> None:
        """Raises SimulationError where a solution that failed is not to be kept."""
        if not (report.converged or report.rounded or self.config.unconverged == "accept"):
            raise SimulationError(
                f"{report.note}, with a residual of {report.residual:.1e}; {worst_cell(self.model, self.newton.u)}"
            )

    def _require_uninverted(self, u: wp.array) -> None:
        """Raises SimulationError where a material that does not bear inversion has it at ``u``."""
        if self.newton.potential.has_barriers and not np.isfinite(self.model.elastic_energy(u)):
            raise SimulationError(f"the step ends with infinite energy; {worst_cell(self.model, u)}")

    def _scale(self, factor: float, a: wp.array, product_out: wp.array) -> None:
        """Writes factor a, for different arrays."""
        product_out.zero_()
        self.newton.potential.add_scaled(product_out, factor, a, product_out)
