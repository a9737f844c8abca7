"""Newton's method with line search on an incremental potential, and the single linear solve."""

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warpfem.errors import SceneError, SimulationError
from warpfem.linear import METHODS, Hessian, LinearMethod, LinearSolver, LinearStatus
from warpfem.model import Model, Route
from warpfem.solvers.base import (
    ROUNDING_LIMIT,
    StepReport,
    require_count,
    require_finite,
    require_tolerance,
    worst_cell,
)
from warpfem.solvers.incremental_potential import IncrementalPotential

SETTLED_LIMIT = 0.05
"""Largest relative residual that rounding may leave if the last linear solve hardly changed the increment: more, as
of cells far stiffer than others, can hold a force that matters."""

POLISH = 1e-4
"""Relative residual of the last linear solve of a step that rounding ends."""

STAGNANT_ROUNDINGS = 16.0
"""Roundings of the force, one for each of the cells about a point, that a residual may hold that no longer falls, and
that the forces of a body may hold that has come to rest."""

FRICTION_UPDATES = 10
"""Newton iterations of a step that take the friction limits of their iterate; later ones keep the last, so that
they minimise one potential and cannot circle between two sets of sliding points."""


@dataclass(frozen=True)
class NewtonSettings:
    """How an incremental potential is minimised.

    Attributes:
        tolerance: largest accepted norm of the unbalanced force of any body, relative to the largest of its
            inertia, internal force, load and contact, where it is not held; it does not depend on units, dt or
            mesh size.
        max_iterations: Newton iterations.
        hessian: what Newton's method does where the stiffness is not positive definite, which the linear solve
            notices: "absolute" takes the absolute values of each cell's eigenvalues (Chen et al. 2024),
            "clamped" sets the negative ones to zero (Teran et al. 2005), "exact" goes along the direction of
            negative curvature. A linearised step takes them everywhere. Materials that are not isotropic
            always use "exact".
        differential: route of the stiffness product: "assembled", "closed" or "tape".
        line_search: whether steps are shortened until the potential falls.
        linear_solver: "conjugate_gradients", "cholesky" or "multigrid", or "auto" by size and difficulty.
        linear_iterations: limit of conjugate gradients for one linear solve.
    """

    tolerance: float = 1e-4
    max_iterations: int = 50
    hessian: Hessian = "absolute"
    differential: Route = "assembled"
    line_search: bool = True
    linear_solver: LinearMethod = "auto"
    linear_iterations: int = 2000

    def __post_init__(self) -> None:
        require_tolerance(self, "tolerance")
        for name in ("max_iterations", "linear_iterations"):
            require_count(self, name, 1)
        require_choice(self, "hessian", ("absolute", "clamped", "exact"))
        require_choice(self, "differential", ("assembled", "closed", "tape"))
        require_choice(self, "linear_solver", METHODS)
        if self.linear_solver in ("cholesky", "multigrid") and self.differential != "assembled":
            raise SceneError(
                f"{type(self).__name__}: linear_solver={self.linear_solver!r} needs differential='assembled'"
            )
        if self.differential == "tape" and self.hessian != "exact":
            raise SceneError(f"{type(self).__name__}: the tape cannot filter eigenvalues: take hessian='exact'")


def require_choice(settings: object, name: str, choices: tuple[str, ...]) -> None:
    """Raises SceneError unless a setting is one of some texts."""
    value = getattr(settings, name)
    if not isinstance(value, str) or value not in choices:
        listed = f"{', '.join(map(repr, choices[:-1]))} or {choices[-1]!r}"
        raise SceneError(f"{type(settings).__name__}: {name} must be {listed}, not {value!r}")


class Newton:
    """Minimises the incremental potential of a model.

    Args:
        model: the model.
        settings: how.
        static: whether without inertia.
        watchful: whether negative curvature that the forces feel must not go unnoticed.

    Attributes:
        linear: what solves the linear systems.
        potential: what is minimised; its ``pose`` and ``predicted`` come first.
        u: displacements reached, device array [m].
        d: the increment that led there, u - u_b without its rounding, device array [m].
    """

    def __init__(self, model: Model, settings: NewtonSettings, *, static: bool = False, watchful: bool = False) -> None:
        self.model = model
        self.settings = settings
        self.potential = IncrementalPotential(model, settings.differential)
        self.linear = LinearSolver(self.potential.operator, settings.linear_solver, static, watchful)
        self.u, self._trial, self.d, self._trial_d, self._direction = (model.zeros() for _ in range(5))

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        own = [self.u, self._trial, self.d, self._trial_d, self._direction]
        return [*own, *self.linear.arrays(), *self.potential.arrays()]

    def prepare(self) -> None:
        """Compiles or loads the kernels of a linear solve: a step in free flight solves nothing."""
        potential = self.potential
        potential.force.fill_(1.0)
        if self.model.supports is not None:
            self.model.supports.project(potential.force)
        potential.linearize(self.u, "exact")
        self.linear.solve(potential.force, self._direction, tolerance=1e-12, max_iterations=2)
        potential.rounding(self.d, self.u)

    # --- where to start ---------------------------------------------------------------------------------

    def start_at_base(self) -> float:
        """Starts from d = 0; returns the potential there [J]."""
        self.d.zero_()
        self.potential.move(self.d, self.u)
        return self.potential.value(self.d, self.u)

    def start_where_it_is(self) -> float:
        """Starts from :attr:`u`, which an earlier solve has reached; returns the potential there [J]."""
        self.potential.add_scaled(self.u, -1.0, self.potential.base, self.d)
        self.potential.move(self.d, self.u)
        return self.potential.value(self.d, self.u)

    def start_in_flight(self, standing: float, acceleration: wp.array | None = None) -> float:
        """Starts from free flight instead, if that has less potential than ``standing`` and can be reached.

        Args:
            standing: the potential of the start that has been chosen [J].
            acceleration: what it is expected to be, device array [m/s^2]; ``None`` for that of dead loads alone.

        Returns:
            The potential of the start [J].
        """
        potential = self.potential
        potential.fly(self._trial_d, acceleration)
        potential.move(self._trial_d, self._trial)
        flying = potential.value(self._trial_d, self._trial)
        if (flying < standing or not np.isfinite(standing)) and not self._trial_is_behind_an_obstacle():
            self._take_trial()
            return flying
        return standing

    def _trial_is_behind_an_obstacle(self) -> bool:
        if not self.potential.limits_steps:
            return False
        self.potential.add_scaled(self._trial_d, -1.0, self.d, self._direction)
        return self.potential.longest_step(self.u, self._direction, contact_only=True) < 1.0

    def _take_trial(self) -> None:
        self.u, self._trial = self._trial, self.u
        self.d, self._trial_d = self._trial_d, self.d

    # --- the iteration ----------------------------------------------------------------------------------

    def minimise(self, value: float, time: float) -> StepReport:
        """Iterates from the start that was chosen, whose potential is ``value`` [J]; ``time`` [s] is for messages.

        Raises:
            SimulationError: the start has infinite potential, or a force is not finite.
        """
        settings, model, potential = self.settings, self.model, self.potential
        rough = model.contact is not None and model.contact.rough
        if not np.isfinite(value):
            raise SimulationError(
                f"t = {time:.6g} s: the step starts from infinite energy; {worst_cell(model, self.u)}. Start from a "
                "state with J > 0, move supports more slowly, or take StableNeoHookean, which bears inversion"
            )
        solves = cg_iterations = 0
        polished = 0
        note = f"stopped after {settings.max_iterations} Newton iterations"
        for iteration in range(settings.max_iterations + 1):
            if rough and 0 < iteration <= FRICTION_UPDATES:
                model.contact.limit_friction(self.u)
                value = potential.value(self.d, self.u)
            residuals, scales = potential.unbalanced_force(self.d, self.u)
            if not np.isfinite(residuals).all():
                require_finite(model, potential.force, "the force", time)
            relative = _largest_ratio(residuals, scales)
            if relative <= settings.tolerance:
                return StepReport(solves, cg_iterations, relative)
            last = iteration == settings.max_iterations
            potential.linearize(self.u, "exact")
            roundings, noise = potential.rounding(self.d, self.u)
            forcing = max(min(0.1, relative**0.5), 0.1 * settings.tolerance / relative)
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
            if result.status is LinearStatus.CURVATURE and settings.hessian != "exact":
                potential.linearize(self.u, settings.hessian)
                result = self._solve(forcing)
                solves += 1
                cg_iterations += result.iterations
            if not settings.line_search:
                potential.add_scaled(self.d, 1.0, self._direction, self.d)
                potential.move(self.d, self.u)
                continue
            slope = -model.dot(potential.force, self._direction)
            noise += 16.0 * model.types.epsilon * abs(value)
            found = self._line_search(value, slope, noise)
            if found is None:
                if -slope <= noise or self._is_noise(residuals, scales, STAGNANT_ROUNDINGS * roundings):
                    return self._rounded(StepReport(solves, cg_iterations, relative), scales, roundings)
                note = f"no step along Newton's direction lowers the potential (iteration {iteration + 1})"
                break
            value = found
        return StepReport(solves, cg_iterations, relative, False, note=note)

    def _is_noise(self, residuals: np.ndarray, scales: np.ndarray, roundings: np.ndarray) -> bool:
        """Whether each body's residual meets the tolerance or cannot be told from rounding."""
        return bool((residuals <= np.maximum(roundings, self.settings.tolerance * scales)).all())

    def _rounded(self, report: StepReport, scales: np.ndarray, roundings: np.ndarray) -> StepReport:
        """The end of a step of which rounding hides the rest: good if that is little, or if no force acts at all."""
        model, relative = self.model, report.residual
        noise = STAGNANT_ROUNDINGS * roundings
        all_is_noise = (scales <= noise).all()
        at_rest = all_is_noise and model.dead_load is None and model.contact_energy(self.u) == 0.0
        note = f"resolved only to the rounding of {model.dtype}"
        settled = relative <= SETTLED_LIMIT and self._correction() <= ROUNDING_LIMIT
        converged = bool(at_rest or relative <= ROUNDING_LIMIT or settled or self._is_small_beside_reactions(noise))
        return replace(report, converged=converged, rounded=True, note=note)

    def _is_small_beside_reactions(self, noise: np.ndarray) -> bool:
        """Whether forces are within the tolerance of those that hold each body where supports strain it."""
        return bool((noise <= self.settings.tolerance * self.potential.internal_norms(self.u)).all())

    def _correction(self) -> float:
        """The size of the last linear solve's solution, relative to the increment."""
        size, correction = self.model.dot(self.d, self.d), self.model.dot(self._direction, self._direction)
        return (correction / size) ** 0.5 if size > 0.0 else np.inf

    def _line_search(self, value: float, slope: float, noise: float) -> float | None:
        """Backtracks from the full step until the potential falls enough (Armijo); None if it never does.

        Where a material does not bear inversion, the full step is the longest that keeps J > 0. Near the minimum
        the fall drowns in the rounding of the potential, ``noise``. There the slope decides, which rounding
        spares (after Hager and Zhang 2005): a step will do that still descends at its end, or a full one that
        overshoots by half.
        """
        model, potential = self.model, self.potential
        length = full = potential.longest_step(self.u, self._direction)
        for _ in range(40):
            potential.add_scaled(self.d, length, self._direction, self._trial_d)
            potential.move(self._trial_d, self._trial)
            reached = potential.value(self._trial_d, self._trial)
            fell = reached <= value + 1e-4 * length * slope
            if not fell and reached <= value + noise:
                potential.unbalanced_force(self._trial_d, self._trial)
                fell = -model.dot(potential.force, self._direction) <= (-0.5 * slope if length == full else 0.0)
            if fell:
                self._take_trial()
                return reached
            length *= 0.5
        return None

    def _solve(self, tolerance: float):
        return self.linear.solve(
            self.potential.force,
            self._direction,
            tolerance=tolerance,
            max_iterations=self.settings.linear_iterations,
        )

    # --- one linear system ------------------------------------------------------------------------------

    def solve_once(self, linear_tolerance: float, time: float) -> StepReport:
        """One linear solve from d = 0; ``time`` [s] is for messages.

        Raises:
            SimulationError: what comes of it is not finite.
        """
        settings, model, potential = self.settings, self.model, self.potential
        self.d.zero_()
        potential.move(self.d, self.u)
        residuals, _ = potential.unbalanced_force(self.d, self.u)
        if not np.isfinite(residuals).all():
            require_finite(model, potential.force, "the force", time)
        potential.linearize(self.u, settings.hessian)
        result = self._solve(linear_tolerance)
        slope = -model.dot(potential.force, self._direction)
        potential.add_scaled(self.d, 1.0, self._direction, self.d)
        potential.move(self.d, self.u)
        residuals, scales = potential.unbalanced_force(self.d, self.u)
        if not (np.isfinite(slope) and np.isfinite(residuals).all()):
            require_finite(model, self.u, "the displacement", time)
        relative = _largest_ratio(residuals, scales)
        if result.status in (LinearStatus.ITERATIONS, LinearStatus.CURVATURE):
            note = f"conjugate gradients {result.status.value}"
        elif result.residual > max(10.0 * linear_tolerance, ROUNDING_LIMIT):
            note = f"rounding of {model.dtype} leaves {result.residual:.1e} of the linear system's right-hand side"
        elif -model.dot(potential.force, self._direction) <= -0.5 * slope:  # as a line search has it; else look closer
            note = ""
        else:
            note = self._rise()
        return StepReport(1, result.iterations, relative, not note, note=note)

    def _rise(self) -> str:
        """Says how far the potential reached is above that of standing still; empty if it is not."""
        potential = self.potential
        rounding = potential.rounding(self.d, self.u)[1]
        reached = potential.value(self.d, self.u)
        self._trial_d.zero_()
        potential.move(self._trial_d, self._trial)
        start = potential.value(self._trial_d, self._trial)
        rise = reached - start
        if rise <= 1e-3 * abs(start) + rounding:
            return ""
        return f"the linear system led {rise:.2g} J above the potential of standing still"


def _largest_ratio(residuals: np.ndarray, scales: np.ndarray) -> float:
    """The largest of residuals relative to their scales; a residual on which nothing acts counts as 0."""
    return float(np.divide(residuals, scales, out=np.zeros_like(scales), where=scales > 0.0).max())
