"""Static equilibrium: the state of least potential under the loads, without inertia."""

import copy
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpfem.errors import SceneError, SimulationError
from warpfem.folds import folds
from warpfem.linear import METHODS, LinearMethod, LinearStatus
from warpfem.model import Model, State
from warpfem.solvers.base import StepReport, require_count, require_tolerance, worst_cell
from warpfem.solvers.newton import Newton, NewtonSettings, require_choice
from warpfem.solvers.rigid_modes import free_rigid_modes

LEAST_INCREMENT = 2.0**-8
"""Part of the load below which no increment is tried."""

INCREMENT_ITERATIONS = 100
"""Newton iterations after which an increment is halved."""

LINEAR_ITERATIONS = 20_000
"""Limit of conjugate gradients for one linear solve: without inertia, nearly incompressible or slender bodies take
thousands, and each solve that is cut short begins anew."""

NOTABLE_RESIDUAL = 1e-3
"""Relative residual above which an equilibrium that the rounding of float32 ends is warned of."""

MOST_BEND = 0.21
"""How far supports may stray from the straight within an increment, relative to their way: a turn by 90 degrees."""

JUMP = 2.0
"""Displacement per load, relative to that of the increment before, from which negative curvature means a jump."""

LARGE_JUMP = 4.0
"""The same where no negative curvature was met: Newton's method can step across it."""


_UNSTABLE = (
    ". The stiffness has directions of negative curvature there: the path of equilibria turns unstable (snap-through "
    "or buckling). See what the bodies do with BackwardEuler, or prescribe a motion in place of the load"
)


_SADDLE = (
    "the equilibrium that was found is unstable: its stiffness has a direction of negative curvature, along which the "
    "bodies would buckle. Let them start a little off it (Body.displacement) to find the one that they fall into"
)


@dataclass(frozen=True)
class LoadIncrement:
    """An equilibrium on the way to the full load.

    Attributes:
        fraction: part of the loads and of the prescribed motions that acts, 1 at the end.
        report: how it was found.
        stable: whether its stiffness was found free of negative curvature; asked only at the end.
        linear_solver: what solved the linear systems, and why.
    """

    fraction: float
    report: StepReport
    stable: bool = True
    linear_solver: str = ""


@dataclass(frozen=True)
class StaticEquilibrium:
    """Newton's method with line search on the potential energy of elasticity, loads and obstacles.

    Where descent from the given state fails, or prescribed motions turn by more than about 90 degrees, loads and
    prescribed motions are applied in increments, starting from the rest shape without loads. At the fraction s of the
    way dead loads are s times their value, and points of a prescribed motion are where it has them at s times the final
    time, less what is left of the jump that it begins with, if it does. An increment that fails, or in which the bodies
    jump, is halved; after one that does not, the next is twice as long.

    Attributes:
        tolerance: largest accepted norm of the unbalanced force, relative to the largest of internal force, load
            and contact.
        max_iterations: Newton iterations of one solve.
        load_steps: increments to apply at least; 1 tries to do without. Descent finds an equilibrium beyond a
            snap-through too, where increments stop with a message.
        linear_solver: as of ``NewtonSettings``.
    """

    tolerance: float = 1e-5
    max_iterations: int = 200
    load_steps: int = 1
    linear_solver: LinearMethod = "auto"

    def __post_init__(self) -> None:
        require_tolerance(self, "tolerance")
        require_count(self, "max_iterations", 2)
        require_count(self, "load_steps", 1)
        require_choice(self, "linear_solver", METHODS)

    def solve(self, model: Model, state: State, time: float | None = None) -> StepReport:
        """Moves ``state`` to an equilibrium, at rest.

        It is the one that descent from the state leads to, or that increments of the load lead to.

        Args:
            model: the model.
            state: the start.
            time: when prescribed motions are held [s]; ``None`` for the state's time.

        Returns:
            The report of all increments; ``parts`` counts them.

        Raises:
            SceneError: a body can move freely: the message names how; or an obstacle has friction, with which the
                equilibrium depends on the way there.
            SimulationError: none is found, or one with inverted cells, or with a body folded into itself; the message
                says up to which part of the load there was one. The state is then as it was before.
        """
        start = state.copy()
        reports: list[StepReport] = []
        try:
            for increment in self.increments(model, state, time):
                reports.append(increment.report)
        except BaseException:
            wp.copy(state.u, start.u)
            wp.copy(state.v, start.v)
            state.time = start.time
            state.revision += 1
            raise
        total = reports[0]
        for report in reports[1:]:
            total = total + report
        return total

    def increments(self, model: Model, state: State, time: float | None = None) -> Iterator[LoadIncrement]:
        """As :meth:`solve`, with a stop at every equilibrium on the way, which ``state`` then is.

        Raises:
            SceneError: as :meth:`solve`.
            SimulationError: likewise. The state is the last equilibrium found; if there is none, the rest shape.
        """
        require_solvable(model)
        model = at_rest(model)
        end = state.time if time is None else time
        straight = model.supports is None or model.supports.bend(end, 0.0, 1.0) <= MOST_BEND
        if self.load_steps == 1 and straight:
            newton = StaticNewton(model, self._newton(self.max_iterations), static=True)
            if model.supports is not None:
                model.supports.advance(end, 0.0)
            try:
                report = newton.solve(state)
                if not newton.stable():
                    raise SimulationError("the equilibrium that was found is unstable")
            except SimulationError:
                del newton  # and its arrays
            else:
                newton.accept(state, end)
                yield LoadIncrement(1.0, report, linear_solver=str(newton.linear))
                return
        yield from self._climb(model, state, end)

    def _newton(self, iterations: int) -> NewtonSettings:
        return NewtonSettings(
            self.tolerance, iterations, linear_solver=self.linear_solver, linear_iterations=LINEAR_ITERATIONS
        )

    def _climb(self, model: Model, state: State, end: float) -> Iterator[LoadIncrement]:
        """Applies loads and motions in increments, from the rest shape."""
        loaded = model
        if model.dead_load is not None:
            loaded = copy.copy(model)
            loaded.dead_load = wp.clone(model.dead_load)
            full = model.dead_load.numpy().copy()
        iterations = min(self.max_iterations, INCREMENT_ITERATIONS)
        newton = StaticNewton(loaded, self._newton(iterations), static=True, watchful=True)
        state.u.zero_()
        state.v.zero_()
        longest = 1.0 / self.load_steps
        fraction, length = 0.0, min(0.5, longest)
        rate: float | None = None
        halved = False
        while fraction < 1.0:
            if model.supports is not None:
                while model.supports.bend(end, fraction, min(fraction + length, 1.0)) > MOST_BEND:
                    if length <= LEAST_INCREMENT:
                        break  # a motion that is not smooth
                    length *= 0.5
            goal = fraction + length if fraction + length < 1.0 - 1e-9 else 1.0
            if model.dead_load is not None:
                loaded.dead_load.assign(goal * full)
            if model.supports is not None:
                model.supports.approach(end, goal)
            try:
                report = newton.solve(state)
                next_rate = newton.distance() / (goal - fraction)
                newton.curved |= rate is not None and next_rate > LARGE_JUMP * rate
                if newton.curved and (rate is None or next_rate > JUMP * rate):
                    raise SimulationError("the bodies jump from one equilibrium to another")
            except SimulationError as error:
                length = 0.5 * (goal - fraction)
                if length >= LEAST_INCREMENT:
                    halved = True
                    continue
                raise SimulationError(
                    f"equilibria were found up to {100.0 * fraction:.4g} % of the load, none at {100.0 * goal:.4g} %: "
                    f"{error}{_UNSTABLE if newton.curved else ''}"
                ) from error
            newton.accept(state, end * goal)
            fraction, rate, length = goal, next_rate, length if halved else min(2.0 * length, longest)
            halved = False
            stable = goal < 1.0 or newton.stable()
            if not stable:
                warnings.warn(_SADDLE, stacklevel=2)
            yield LoadIncrement(goal, report, stable, str(newton.linear))


def at_rest(model: Model) -> Model:
    """The model with the loads that act on states of rest."""
    load = model.static_load
    if load is model.dead_load:
        return model
    model = copy.copy(model)
    model.dead_load = load
    return model


def require_solvable(model: Model) -> None:
    """Raises SceneError if a body can move freely, or an obstacle has friction."""
    for index, body in enumerate(model.scene.bodies):
        for part, modes in free_rigid_modes(model, index):
            raise SceneError(
                f"body '{body.name}'{part} can move freely: {'; '.join(modes)}. A static equilibrium needs pins "
                "against that (obstacles do not count)"
            )
    if model.contact is not None and model.contact.rough:
        raise SceneError(
            "with friction the equilibrium depends on the way there: take friction=0, or BackwardEuler with "
            "damping until the bodies rest"
        )


def _require_sound(model: Model, u: wp.array) -> None:
    """Raises SimulationError for inverted cells and for bodies folded into themselves."""
    state = State(u, u)
    jacobian, _ = model.diagnostics(state)
    if (jacobian <= 0.0).any():
        raise SimulationError(
            f"the equilibrium that was found has {int((jacobian <= 0.0).sum())} inverted cells: "
            f"{worst_cell(model, u)}. Start nearer to it, with smaller loads, or take NeoHookean"
        )
    x = model.rest_points + state.displacement
    for body, (points, _) in zip(model.scene.bodies, model.body_slices, strict=True):
        found = folds(body.mesh, x[points])
        if len(found):
            raise SimulationError(
                f"the equilibrium that was found has body '{body.name}' folded into itself: its cells turn twice about "
                f"{len(found)} inner places (the first: points {'-'.join(map(str, found[0]))}). Start without inverted "
                "cells"
            )


class StaticNewton(Newton):
    """Newton's method on the potential energy.

    Attributes:
        curved: whether the last solve met negative curvature on its way.
    """

    curved = False

    def solve(self, state: State) -> StepReport:
        """Finds the equilibrium with the supports where they are; leaves it to :meth:`accept` to take it.

        Raises:
            SimulationError: there is none, or one that has inverted cells or folds.
        """
        self.potential.pose(state.u, weight=0.0, duration=1.0)
        self.curved = False
        report = self.minimise(self._start_after_supports(), state.time)
        finer = report.rounded and self.model.dtype == "float32"
        if not report.converged:
            raise SimulationError(
                f"no static equilibrium found: {report.note}, with a residual of {report.residual:.1e}; "
                f"{worst_cell(self.model, self.u)}. "
                + ('Take dtype="float64"' if finer else "Start nearer to it, or with smaller loads")
            )
        _require_sound(self.model, self.u)
        if finer and report.residual > NOTABLE_RESIDUAL:
            warnings.warn(
                f'float32 resolves the equilibrium only to a residual of {report.residual:.1e}: take dtype="float64"',
                stacklevel=2,
            )
        return report

    def accept(self, state: State, time: float) -> None:
        """Moves ``state`` to the equilibrium found."""
        wp.copy(state.u, self.u)
        state.v.zero_()
        state.time = time
        state.revision += 1

    def distance(self) -> float:
        """The norm of the last solve's change of displacement."""
        return self.model.dot(self.d, self.d) ** 0.5

    def stable(self) -> bool:
        """Whether the stiffness has no direction of negative curvature, but by rounding.

        The signs of a factor tell. Without one, conjugate gradients for a random force do: the residual of such a
        direction never falls, so that they cannot pass it by.
        """
        model, potential = self.model, self.potential
        potential.linearize(self.u, "exact")
        definite = self.linear.definite(4.0 * model.types.epsilon)
        if definite is not None:
            return definite
        random = np.random.default_rng(0).standard_normal((model.point_count, model.dim))
        potential.force.assign(random.astype(model.types.numpy))
        if model.supports is not None:
            model.supports.project(potential.force)
        if super()._solve(1e-4).status is not LinearStatus.CURVATURE:
            return True
        p, product = self.linear.direction
        blocks = np.linalg.inv(potential.operator.inverse_diagonal.numpy().astype(np.float64))
        size = np.einsum("pi,pij,pj->", p, blocks, p)
        return float(np.sum(p * product)) >= -4.0 * model.types.epsilon * size

    def _solve(self, tolerance: float):
        result = super()._solve(tolerance)
        self.curved |= result.status is LinearStatus.CURVATURE
        return result

    def _start_after_supports(self) -> float:
        """Starts where supports alone have moved, or where all points have followed them as the stiffness says."""
        model, potential = self.model, self.potential
        held = self.start_at_base()
        if model.supports is None:
            return held
        potential.add_scaled(self.u, -1.0, potential.base, self.d)  # how far the supports have moved
        if model.dot(self.d, self.d) == 0.0:
            return held
        potential.unbalanced_force(self.d, potential.base)
        potential.linearize(potential.base, "exact")
        potential.operator.apply(self.d, potential.part)
        potential.add_scaled(potential.force, -1.0, potential.part, potential.force)
        model.supports.project(potential.force)
        if np.isfinite(model.dot(potential.force, potential.force)):
            self._solve(1e-3)
            potential.add_scaled(self.d, 1.0, self._direction, self._trial_d)
            if potential.longest_step(potential.base, self._trial_d) >= 1.0:
                potential.move(self._trial_d, self._trial)
                following = potential.value(self._trial_d, self._trial)
                if following < held or not np.isfinite(held):
                    self._take_trial()
                    return following
        self.d.zero_()
        return held
