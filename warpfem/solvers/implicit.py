"""Backward Euler: each step minimises the incremental potential by Newton's method."""

import functools
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Literal

import numpy as np
import warp as wp

from warpfem.dtypes import types
from warpfem.errors import SceneError, SimulationError
from warpfem.linear import ConjugateGradients, Hessian, LinearStatus, tangent_operator
from warpfem.model import Model, Route, State
from warpfem.points import CHUNK, chunks
from warpfem.solvers.base import (
    ROUNDING_LIMIT,
    Solver,
    Stepper,
    StepReport,
    require_count,
    require_finite,
    require_positive,
    require_tolerance,
    worst_cell,
)

MAX_HALVINGS = 10
"""How often a step that fails is halved before it is refused."""

SETTLED_LIMIT = 0.05
"""Largest relative residual that rounding may leave if the last linear solve hardly changed the increment: more, as
of cells far stiffer than others, can hold a force that matters."""

POLISH = 1e-4
"""Relative residual of the last linear solve of a step that rounding ends."""

STAGNANT_ROUNDINGS = 16.0
"""Roundings of the force, one for each of the cells about a point, that a residual may hold that no longer falls."""

FRICTION_UPDATES = 10
"""Newton iterations of a step that take the friction limits of their iterate; later ones keep the last, so that
they minimise one potential and cannot circle between two sets of sliding points."""


@functools.cache
def _implicit_kernels(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    vector, matrix, scalar = t.vector, t.matrix, t.scalar
    module = f"warpfem.implicit_{dim}_{dtype}"

    @wp.kernel(module=module, enable_backward=False)
    def add_scaled(
        a: wp.array(dtype=vector),
        factor: scalar,
        b: wp.array(dtype=vector),
        sum_out: wp.array(dtype=vector),
    ):
        """Writes a + factor b."""
        i = wp.tid()
        sum_out[i] = a[i] + factor * b[i]

    @wp.kernel(module=module, enable_backward=False)
    def free_flight(
        predicted: wp.array(dtype=vector),
        load: wp.array(dtype=vector),
        inverse_mass: wp.array(dtype=scalar),
        inverse_weight: scalar,
        increment_out: wp.array(dtype=vector),
    ):
        """Writes how far dead loads alone would take the points."""
        i = wp.tid()
        increment_out[i] = predicted[i] + (inverse_weight * inverse_mass[i]) * load[i]

    @wp.kernel(module=module, enable_backward=False)
    def inertia_energy(
        mass: wp.array(dtype=scalar),
        weight: scalar,
        predicted: wp.array(dtype=vector),
        increment: wp.array(dtype=vector),
        energy_out: wp.array(dtype=wp.float64),
    ):
        """Adds weight/2 |increment - predicted|^2_M."""
        first = wp.tid() * CHUNK
        last = wp.min(first + CHUNK, increment.shape[0])
        total = wp.float64(0.0)
        for i in range(first, last):
            d = increment[i] - predicted[i]
            square = wp.float64(0.0)
            for k in range(dim):
                square += wp.float64(d[k]) * wp.float64(d[k])
            total += wp.float64(mass[i]) * square
        wp.atomic_add(energy_out, 0, wp.float64(0.5) * wp.float64(weight) * total)

    @wp.kernel(module=module, enable_backward=False)
    def inertia_force(
        mass: wp.array(dtype=scalar),
        weight: scalar,
        predicted: wp.array(dtype=vector),
        increment: wp.array(dtype=vector),
        force_out: wp.array(dtype=vector),
    ):
        """Writes -weight M (increment - predicted)."""
        i = wp.tid()
        force_out[i] = (weight * mass[i]) * (predicted[i] - increment[i])

    @wp.kernel(module=module, enable_backward=False)
    def rounding(
        inverse_diagonal: wp.array(dtype=matrix),
        mass: wp.array(dtype=scalar),
        weight: scalar,
        epsilon: scalar,
        u: wp.array(dtype=vector),
        increment: wp.array(dtype=vector),
        force_out: wp.array(dtype=vector),
        work_out: wp.array(dtype=wp.float64),
    ):
        """Writes the change of force that one rounding of u and of the increment makes, and sums its work.

        It is epsilon (|K_ii| |u_i| + weight m_i |d_i|) with the blocks K_ii + weight m_i I on the diagonal.
        """
        i = wp.tid()
        inertia = weight * mass[i]
        scale = wp.trace(inverse_diagonal[i])
        block = wp.inverse(inverse_diagonal[i] / scale) / scale
        force = vector()
        work = scalar(0.0)
        for k in range(dim):
            elastic = scalar(0.0)
            for j in range(dim):
                entry = block[k, j]
                if j == k:
                    entry -= inertia
                elastic += wp.abs(entry * u[i][j])
            moved = wp.abs(increment[i][k])
            force[k] = epsilon * (elastic + inertia * moved)
            work += epsilon * (elastic * wp.abs(u[i][k]) + inertia * moved * moved)
        force_out[i] = force
        wp.atomic_add(work_out, 0, wp.float64(work))

    return SimpleNamespace(
        add_scaled=add_scaled,
        free_flight=free_flight,
        inertia_energy=inertia_energy,
        inertia_force=inertia_force,
        rounding=rounding,
    )


class _BackwardEulerStepper(Stepper):
    """The unknown is the increment d = u - u_t of the displacement; the incremental potential is

    Phi(d) = w/2 |d - d~|^2_M + U(u) - f_dead . u + contact(u) + friction(u),  u = u_t + d,

    with w = (1 + alpha dt) / dt^2 and d~ = dt v_t / (1 + alpha dt), alpha the damping. Inertia and velocity come
    from d itself: the difference of two displacements would lose it in short steps.
    """

    def __init__(self, model: Model, config: "BackwardEuler") -> None:
        self.model = model
        self.config = config
        self.kernels = _implicit_kernels(model.dim, model.dtype)
        self.operator = tangent_operator(model, config.differential)
        self.cg = ConjugateGradients(model)
        self._u, self._trial, self._d, self._trial_d = (model.zeros() for _ in range(4))
        self._predicted, self._force, self._part, self._direction = (model.zeros() for _ in range(4))
        self._sum = wp.zeros(1, dtype=wp.float64, device=model.device)
        self._barriers = [block for block in model.blocks if block.kernels.constitutive.barrier]
        limited = self._barriers or (model.contact is not None and model.contact.limits_steps)
        self._limit = wp.zeros(1, dtype=model.types.scalar, device=model.device) if limited else None

    def arrays(self) -> list[wp.array]:
        own = [self._u, self._trial, self._d, self._trial_d, self._predicted]
        own += [self._force, self._part, self._direction, self._sum]
        if self._limit is not None:
            own.append(self._limit)
        return [*own, *self.cg.arrays(), *self.operator.arrays()]

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
                    self.attempt = self._u
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

    def _single_step(self, state: State, dt: float) -> StepReport:
        """One step, by which ``state`` changes only if it succeeds.

        Raises:
            SimulationError: it does not.
        """
        model = self.model
        time = state.time + dt
        damping = model.scene.damping
        self._weight = (1.0 + damping * dt) / dt**2
        self._start, self._dt = state.u, dt
        self._predicted.zero_()
        self._launch("add_scaled", [self._predicted, dt / (1.0 + damping * dt), state.v], [self._predicted])
        if model.supports is not None:
            model.supports.advance(time, dt)
        if model.contact is not None:
            model.contact.limit_friction(state.u)
        report = self._newton(state, time) if self.config.max_iterations > 1 else self._linearised(state, time)
        if self._crosses_an_obstacle(state):
            report = replace(report, converged=False, rounded=False, note="a point goes round or through a sphere")
        if not (report.converged or report.rounded or self.config.unconverged == "accept"):
            raise SimulationError(
                f"{report.note}, with a residual of {report.residual:.1e}; {worst_cell(model, self._u)}"
            )
        state.v.zero_()
        self._launch("add_scaled", [state.v, 1.0 / dt, self._d], [state.v])
        wp.copy(state.u, self._u)
        if model.supports is not None:
            model.supports.hold(state.u, state.v)
        state.time = time
        state.revision += 1
        return report

    def _crosses_an_obstacle(self, state: State) -> bool:
        """Whether the way of a point within the step, straight from its start, leads through the core of a sphere."""
        contact = self.model.contact
        if contact is None or not contact.limits_steps:
            return False
        self._limit.fill_(1.0)
        contact.limit_step(state.u, self._d, self._limit)
        return float(self._limit.numpy()[0]) < 1.0

    def prepare(self, state: State, dt: float) -> None:
        super().prepare(state, dt)
        # a step in free flight solves nothing
        self._force.fill_(1.0)
        if self.model.supports is not None:
            self.model.supports.project(self._force)
        self._linearize("exact")
        self.cg.solve(self.operator, self._force, self._direction, tolerance=0.5, max_iterations=1)
        self._rounding()

    # --- one linear system: the lecture's step ----------------------------------------------------------

    def _linearised(self, state: State, time: float) -> StepReport:
        if self.model.contact is not None:
            self._launch("add_scaled", [state.u, 1.0, self._predicted], [self._part])
            self.model.contact.linearize_friction(state.u, self._dt, self._part)
        self._d.zero_()
        self._move(self._d, self._u)
        start = self._potential(self._d, self._u)
        self._unbalanced_force(self._d, self._u)
        require_finite(self.model, self._force, "the force", time)
        self._linearize(self.config.hessian)
        result = self._solve(self.config.linear_tolerance)
        self._launch("add_scaled", [self._d, 1.0, self._direction], [self._d])
        self._move(self._d, self._u)
        require_finite(self.model, self._u, "the displacement", time)
        linear_residual = self._true_residual()
        relative = _largest_ratio(*self._unbalanced_force(self._d, self._u))
        rounding = self._rounding()[1]
        rise = self._potential(self._d, self._u) - start
        if result.status is not LinearStatus.CONVERGED:
            note = f"conjugate gradients {result.status.value}"
        elif linear_residual > max(10.0 * self.config.linear_tolerance, ROUNDING_LIMIT):
            note = f"rounding of {self.model.dtype} leaves {linear_residual:.1e} of the linear system's right-hand side"
        elif not rise <= 1e-3 * abs(start) + rounding:
            note = f"the linear system led {rise:.2g} J above the potential of standing still"
        else:
            note = ""
        return StepReport(1, result.iterations, relative, not note, note=note)

    def _true_residual(self) -> float:
        """|b - A x| / |b| of the linear system: the one that conjugate gradients keep drifts away by rounding."""
        size = self.model.dot(self._force, self._force) ** 0.5
        self.operator.apply(self._direction, self._part)
        self._launch("add_scaled", [self._force, -1.0, self._part], [self._part])
        return self.model.dot(self._part, self._part) ** 0.5 / size if size > 0.0 else 0.0

    # --- Newton's method --------------------------------------------------------------------------------

    def _newton(self, state: State, time: float) -> StepReport:
        config, model = self.config, self.model
        rough = model.contact is not None and model.contact.rough
        potential = self._choose_start(state)
        if not np.isfinite(potential):
            require_finite(model, state.u, "the displacement", state.time)
            require_finite(model, state.v, "the velocity", state.time)
            raise SimulationError(
                f"t = {time:.6g} s: the step starts from infinite energy; {worst_cell(model, self._u)}. Start from a "
                "state with J > 0, move supports more slowly, or take StableNeoHookean, which bears inversion"
            )
        solves = cg_iterations = 0
        polished = 0
        note = f"stopped after {config.max_iterations} Newton iterations"
        for iteration in range(config.max_iterations + 1):
            if rough and 0 < iteration <= FRICTION_UPDATES:
                model.contact.limit_friction(self._u)
                potential = self._potential(self._d, self._u)
            residuals, scales = self._unbalanced_force(self._d, self._u)
            if not np.isfinite(residuals).all():
                require_finite(model, self._force, "the force", time)
            relative = _largest_ratio(residuals, scales)
            if relative <= config.tolerance:
                return StepReport(solves, cg_iterations, relative)
            last = iteration == config.max_iterations
            self._linearize("exact")
            roundings, noise = self._rounding()
            forcing = max(min(0.1, relative**0.5), 0.1 * config.tolerance / relative)
            if self._is_noise(residuals, scales, STAGNANT_ROUNDINGS * roundings if last else roundings):
                if last or polished == 2 or (polished and self._correction() <= ROUNDING_LIMIT):
                    return self._rounded(StepReport(solves, cg_iterations, relative), scales, roundings)
                # noise of stiff cells may hide a force that moves the whole body, but not from one more solve
                polished, forcing = polished + 1, POLISH
            if last:
                break
            result = self._solve(forcing)
            solves += 1
            cg_iterations += result.iterations
            if result.status is LinearStatus.CURVATURE and config.hessian != "exact":
                self._linearize(config.hessian)
                result = self._solve(forcing)
                solves += 1
                cg_iterations += result.iterations
            if not config.line_search:
                self._launch("add_scaled", [self._d, 1.0, self._direction], [self._d])
                self._move(self._d, self._u)
                continue
            slope = -model.dot(self._force, self._direction)
            noise += 16.0 * model.types.epsilon * abs(potential)
            found = self._line_search(potential, slope, noise)
            if found is None:
                if -slope <= noise or self._is_noise(residuals, scales, STAGNANT_ROUNDINGS * roundings):
                    return self._rounded(StepReport(solves, cg_iterations, relative), scales, roundings)
                note = f"no step along Newton's direction lowers the potential (iteration {iteration + 1})"
                break
            potential = found
        return StepReport(solves, cg_iterations, relative, False, note=note)

    def _is_noise(self, residuals: np.ndarray, scales: np.ndarray, roundings: np.ndarray) -> bool:
        """Whether each body's residual meets the tolerance or cannot be told from rounding."""
        return bool((residuals <= np.maximum(roundings, self.config.tolerance * scales)).all())

    def _rounded(self, report: StepReport, scales: np.ndarray, roundings: np.ndarray) -> StepReport:
        """The end of a step of which rounding hides the rest: good if that is little, or if no force acts at all."""
        model, relative = self.model, report.residual
        all_is_noise = (scales <= 4.0 * roundings).all()
        at_rest = all_is_noise and model.dead_load is None and model.contact_energy(self._u) == 0.0
        note = f"resolved only to the rounding of {model.dtype}"
        settled = relative <= SETTLED_LIMIT and self._correction() <= ROUNDING_LIMIT
        converged = bool(at_rest or relative <= ROUNDING_LIMIT or settled)
        return replace(report, converged=converged, rounded=True, note=note)

    def _correction(self) -> float:
        """The size of the last linear solve's solution, relative to the increment."""
        size, correction = self.model.dot(self._d, self._d), self.model.dot(self._direction, self._direction)
        return (correction / size) ** 0.5 if size > 0.0 else np.inf

    def _choose_start(self, state: State) -> float:
        """Starts from the old state or from free flight, whichever has less potential and can be reached."""
        model = self.model
        self._d.zero_()
        if model.dead_load is None:
            wp.copy(self._trial_d, self._predicted)
        else:
            arguments = [self._predicted, model.dead_load, model.inverse_mass, 1.0 / self._weight]
            self._launch("free_flight", arguments, [self._trial_d])
        if model.supports is not None:
            model.supports.project(self._trial_d)
        self._move(self._d, self._u)
        self._move(self._trial_d, self._trial)
        still = self._potential(self._d, self._u)
        flying = self._potential(self._trial_d, self._trial)
        if (flying < still or not np.isfinite(still)) and self._longest_step(self._trial_d, contact_only=True) >= 1.0:
            wp.copy(self._d, self._trial_d)
            wp.copy(self._u, self._trial)
            return flying
        return still

    def _line_search(self, potential: float, slope: float, noise: float) -> float | None:
        """Backtracks from the full step until the potential falls enough (Armijo); None if it never does.

        Where a material does not bear inversion, the full step is the longest that keeps J > 0. Near the minimum
        the fall drowns in the rounding of the potential, ``noise``. There the slope decides, which rounding
        spares (after Hager and Zhang 2005): a step will do that still descends at its end, or a full one that
        overshoots by half.
        """
        model = self.model
        length = full = self._longest_step(self._direction)
        for _ in range(40):
            self._launch("add_scaled", [self._d, length, self._direction], [self._trial_d])
            self._move(self._trial_d, self._trial)
            value = self._potential(self._trial_d, self._trial)
            fell = value <= potential + 1e-4 * length * slope
            if not fell and value <= potential + noise:
                self._unbalanced_force(self._trial_d, self._trial)
                fell = -model.dot(self._force, self._direction) <= (-0.5 * slope if length == full else 0.0)
            if fell:
                self._u, self._trial = self._trial, self._u
                self._d, self._trial_d = self._trial_d, self._d
                return value
            length *= 0.5
        return None

    def _longest_step(self, direction: wp.array, contact_only: bool = False) -> float:
        """1, or nine tenths of what takes the first cell that does not bear inversion to J = 0.

        Nor may a point cross an obstacle that it could leave on the other side.
        """
        if self._limit is None:
            return 1.0
        self._limit.fill_(1.0 / 0.9)
        if not contact_only:
            for block in self._barriers:
                block.launch("step_limit", [self._u, direction], [self._limit])
        if self.model.contact is not None:
            self.model.contact.limit_step(self._u, direction, self._limit)
        return min(1.0, 0.9 * float(self._limit.numpy()[0]))

    # --- terms ------------------------------------------------------------------------------------------

    def _launch(self, name: str, inputs: list, outputs: list) -> None:
        kernel, model = getattr(self.kernels, name), self.model
        wp.launch(kernel, model.point_count, inputs=inputs, outputs=outputs, device=model.device)

    def _hold(self, u: wp.array) -> None:
        if self.model.supports is not None:
            self.model.supports.hold(u, self._part)  # the rates go to a work array

    def _move(self, d: wp.array, u_out: wp.array) -> None:
        """Writes u = u_t + d, with held components at their targets."""
        self._launch("add_scaled", [self._start, 1.0, d], [u_out])
        self._hold(u_out)

    def _potential(self, d: wp.array, u: wp.array) -> float:
        """Phi of the increment d, which leads to u."""
        model, total = self.model, self._sum
        total.zero_()
        wp.launch(
            self.kernels.inertia_energy,
            chunks(model.point_count),
            inputs=[model.mass, self._weight, self._predicted, d],
            outputs=[total],
            device=model.device,
        )
        for block in model.blocks:
            block.launch("energy", [u], [total])
        if model.contact is not None:
            model.contact.add_energy(u, total)
            model.contact.add_friction_energy(self._start, self._dt, u, total)
        load = 0.0 if model.dead_load is None else model.dot(model.dead_load, u)
        return float(total.numpy()[0]) - load

    def _unbalanced_force(self, d: wp.array, u: wp.array) -> tuple[np.ndarray, np.ndarray]:
        """Writes -dPhi/dd to ``_force``, zero where held.

        Returns:
            For each body, since none feels another, its norm and that of the largest of its parts, where not held.
        """
        model, force, part = self.model, self._force, self._part
        self._launch("inertia_force", [model.mass, self._weight, self._predicted, d], [force])
        sizes = [self._free_norms(force)]
        part.zero_()
        model.add_internal_force(u, part)
        sizes.append(self._free_norms(part))
        self._launch("add_scaled", [force, 1.0, part], [force])
        if model.dead_load is not None:
            wp.copy(part, model.dead_load)
            sizes.append(self._free_norms(part))
            self._launch("add_scaled", [force, 1.0, part], [force])
        if model.contact is not None:
            part.zero_()
            model.contact.add_force(u, part)
            model.contact.add_friction_force(self._start, self._dt, u, part)
            sizes.append(self._free_norms(part))
            self._launch("add_scaled", [force, 1.0, part], [force])
        return self._free_norms(force), np.max(sizes, axis=0)

    def _free_norms(self, vector: wp.array) -> np.ndarray:
        """Sets the held components of a vector to zero; returns its norm over each body's points."""
        model = self.model
        if model.supports is not None:
            model.supports.project(vector)
        parts = [vector[points] for points, _ in model.body_slices]
        return np.sqrt([model.dot(part, part) for part in parts])

    def _linearize(self, hessian: Hessian) -> None:
        friction = None if self.model.contact is None else (self._start, self._dt)
        self.operator.linearize(self._u, self._weight, hessian=hessian, friction=friction, precondition=True)

    def _solve(self, tolerance: float):
        return self.cg.solve(
            self.operator,
            self._force,
            self._direction,
            tolerance=tolerance,
            max_iterations=self.config.linear_iterations,
        )

    def _rounding(self) -> tuple[np.ndarray, float]:
        """What cannot be told from rounding: each body's norm of the force that one rounding makes, and its work."""
        model = self.model
        arguments = [self.operator.inverse_diagonal, model.mass, self._weight, model.types.epsilon, self._u, self._d]
        self._sum.zero_()
        self._launch("rounding", arguments, [self._part, self._sum])
        work = float(self._sum.numpy()[0])
        return self._free_norms(self._part), work


def _largest_ratio(residuals: np.ndarray, scales: np.ndarray) -> float:
    """The largest of residuals relative to their scales; a residual on which nothing acts counts as 0."""
    return float(np.divide(residuals, scales, out=np.zeros_like(scales), where=scales > 0.0).max())


@dataclass(frozen=True)
class BackwardEuler(Solver):
    """Backward Euler, v = (u - u_t)/dt and M (v - v_t)/dt = f(u) at the end of the step.

    By default each step is solved to ``tolerance`` by Newton's method with line search on the incremental
    potential. :meth:`linearised` is the lecture's single linear solve.

    Attributes:
        tolerance: largest accepted norm of the unbalanced force of any body, relative to the largest of its
            inertia, internal force, load and contact, where it is not held; it does not depend on units, dt or
            mesh size.
        max_iterations: Newton iterations; 1 takes the linearised step.
        hessian: what Newton's method does where the stiffness is not positive definite, which the linear solve
            notices: "absolute" takes the absolute values of each cell's eigenvalues (Chen et al. 2024),
            "clamped" sets the negative ones to zero (Teran et al. 2005), "exact" goes along the direction of
            negative curvature. A linearised step takes them everywhere. Materials that are not isotropic
            always use "exact".
        differential: route of the stiffness product: "assembled", "closed" or "tape".
        line_search: whether steps are shortened until the potential falls.
        unconverged: what becomes of a step that misses the tolerance, unless rounding hides the rest: "halve"
            does it again in two halves, and so on ``MAX_HALVINGS`` times, then raises a SimulationError and leaves
            the state as it was; "accept" keeps what was reached and reports it.
        linear_tolerance: relative residual of the linear solve of a linearised step.
        linear_iterations: limit of conjugate gradients for one linear solve.
    """

    tolerance: float = 1e-4
    max_iterations: int = 50
    hessian: Hessian = "absolute"
    differential: Route = "assembled"
    line_search: bool = True
    unconverged: Literal["halve", "accept"] = "halve"
    linear_tolerance: float = 1e-5
    linear_iterations: int = 2000

    name = "backward_euler"
    order = 1

    def __post_init__(self) -> None:
        for name in ("tolerance", "linear_tolerance"):
            require_tolerance(self, name)
        for name in ("max_iterations", "linear_iterations"):
            require_count(self, name, 1)
        for name, choices in (
            ("hessian", ("absolute", "clamped", "exact")),
            ("unconverged", ("halve", "accept")),
            ("differential", ("assembled", "closed", "tape")),
        ):
            value = getattr(self, name)
            if not isinstance(value, str) or value not in choices:
                listed = f"{', '.join(map(repr, choices[:-1]))} or {choices[-1]!r}"
                raise SceneError(f"BackwardEuler: {name} must be {listed}, not {value!r}")
        if self.differential == "tape" and self.hessian != "exact":
            raise SceneError("BackwardEuler: the tape cannot filter eigenvalues: take hessian='exact'")

    @classmethod
    def linearised(
        cls, differential: Route = "assembled", linear_tolerance: float = 1e-5, hessian: Hessian = "exact"
    ) -> "BackwardEuler":
        """One linear solve a step: (M + dt^2 K(u_t)) v = M v_t + dt f(u_t) (Hu 2020, eq. 11).

        The K of the lecture is "exact"; "absolute" keeps steps bounded that start far from rest.

        Friction is a drag fitted to the speed of the step's start: sliding points slow down by Coulomb's law
        and sticking ones creep, but a point that comes loose takes many steps to.
        """
        return cls(
            max_iterations=1,
            hessian=hessian,
            differential=differential,
            line_search=False,
            unconverged="accept",
            linear_tolerance=linear_tolerance,
        )

    def stepper(self, model: Model) -> Stepper:
        return _BackwardEulerStepper(model, self)
