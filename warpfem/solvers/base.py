"""What a solver is: immutable configuration that makes a stepper for a model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import warp as wp

from warpfem.errors import SceneError, SimulationError
from warpfem.model import Model, State

ROUNDING_LIMIT = 1e-2
"""Largest relative residual, and relative change by the last linear solve, with which a step counts as converged
where rounding hides the rest."""


@dataclass(frozen=True)
class StepReport:
    """What one step did.

    Attributes:
        newton_iterations: linear systems solved.
        cg_iterations: iterations of conjugate gradients over all of them.
        residual: unbalanced force over the largest of the forces acting, at the end; 0 for explicit steps.
        converged: whether the residual met the tolerance; or is lost in rounding, and below ``ROUNDING_LIMIT``, or
            not much above while the last linear solve hardly changed the increment, or no force acts beyond
            rounding. A linearised step has solved its system and has not raised the potential.
        rounded: whether rounding hides what is left of the residual, so that no other step would do better.
        parts: steps that this one was divided into.
        error: estimate of the error of the step over what its target allows; 0 without a target.
        note: how the step ended, if not by its tolerance.
    """

    newton_iterations: int = 0
    cg_iterations: int = 0
    residual: float = 0.0
    converged: bool = True
    rounded: bool = False
    parts: int = 1
    error: float = 0.0
    note: str = ""

    def __add__(self, other: StepReport) -> StepReport:
        """The report of this step and the next as one; its end is that of the worse."""
        worse = max(self, other, key=lambda part: (not part.converged, part.rounded, part.residual))
        return replace(
            worse,
            newton_iterations=self.newton_iterations + other.newton_iterations,
            cg_iterations=self.cg_iterations + other.cg_iterations,
            parts=self.parts + other.parts,
        )


class Stepper(ABC):
    """Advances states of one model. Holds the work arrays, never the state.

    Attributes:
        model: the model.
        attempt: displacements at which the last step failed, device array, where there are other than the state's.
        adaptive: whether dt is chosen by :meth:`estimate_stable_dt`: then a dt above the limit of the moment is not
            refused, since the next one will be shorter.
        controls_error: whether dt shall follow the errors that :meth:`try_step` estimates.
        linear_solver: what solves the linear systems of a step, and why; empty where there are none.
    """

    model: Model
    attempt: wp.array | None = None
    adaptive: bool = False
    controls_error: bool = False
    linear_solver: str = ""

    @property
    def forces(self) -> str:
        """How a step computes the internal forces, and on how many threads."""
        return self.model.describe_forces()

    @abstractmethod
    def step(self, state: State, dt: float) -> StepReport:
        """Advances ``state`` in place by ``dt`` [s].

        Raises:
            SimulationError: the step cannot be taken, and the state is as it was before; or an explicit run has
                blown up, and the state shows it.
        """

    def advance(self, state: State, dt: float, most: int) -> tuple[int, StepReport]:
        """Takes as many steps of ``dt`` [s] as are taken at a time, at least 1 and at most ``most``.

        Returns:
            How many there were, and their report.

        Raises:
            SimulationError: as :meth:`step`.
        """
        return 1, self.step(state, dt)

    def try_step(self, state: State, dt: float) -> StepReport:
        """Advances ``state`` by ``dt`` [s] if the error of the step is within its target, else leaves it as it was.

        Raises:
            SimulationError: the step cannot be taken as a whole, and the state is as it was before.
        """
        raise NotImplementedError(f"{type(self).__name__} does not estimate errors")

    @abstractmethod
    def arrays(self) -> list[wp.array]:
        """The device arrays held."""

    def stable_dt(self, state: State | None = None) -> float | None:
        """The largest stable time step [s] at rest, or the lesser of that and the one in ``state``.

        Returns:
            The limit, or ``None`` if there is none.

        Raises:
            SimulationError: the stiffness in ``state`` is not finite.
        """
        return None

    def estimate_stable_dt(self, state: State) -> float | None:
        """:meth:`stable_dt` of ``state`` alone, estimated at a fraction of the cost."""
        return None

    def prepare(self, state: State, dt: float) -> None:
        """Takes a step with a copy of ``state``, so that all kernels of a step are compiled or loaded.

        Raises:
            SimulationError: the step cannot be taken.
        """
        self.step(state.copy(), dt)


class Solver(ABC):
    """A time integration scheme with its settings."""

    name: ClassVar[str]
    order: ClassVar[int]
    """Order of accuracy in dt of the positions at a fixed time."""

    @abstractmethod
    def stepper(self, model: Model) -> Stepper:
        """A stepper for ``model``."""


def require_positive(dt: float) -> None:
    """Raises SimulationError unless the time step is a finite number > 0."""
    if not 0.0 < dt < np.inf:
        raise SimulationError(f"dt must be a finite number > 0, not {dt!r}")


def require_tolerance(settings: object, name: str) -> None:
    """Raises SceneError unless a setting is in (0, 1)."""
    value = getattr(settings, name)
    if not (isinstance(value, float | int) and 0.0 < value < 1.0):
        raise SceneError(f"{type(settings).__name__}: {name} must be in (0, 1), not {value!r}")


def require_count(settings: object, name: str, least: int) -> None:
    """Raises SceneError unless a setting is an integer of at least ``least``."""
    value = getattr(settings, name)
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise SceneError(f"{type(settings).__name__}: {name} must be an integer >= {least}, not {value!r}")


def worst_cell(model: Model, u: wp.array) -> str:
    """Names the cell with the least J at the displacements ``u``."""
    jacobian, _ = model.diagnostics(State(u, u))
    cell = int(np.argmin(jacobian))
    body, own = model.body_of_cell(cell)
    return f"cell {own} of body '{body.name}' has J = {jacobian[cell]:.4g}"


def require_finite(model: Model, vector: wp.array, what: str, time: float) -> None:
    """Raises SimulationError that names the first point where ``vector`` is not finite."""
    bad = ~np.isfinite(vector.numpy()).all(axis=1)
    if not bad.any():
        return
    body, point = model.body_of_point(int(np.argmax(bad)))
    raise SimulationError(
        f"t = {time:.6g} s: {what} of point {point} of body '{body.name}' is not finite "
        f"({int(bad.sum())} points in all). A smaller dt, a softer start or a material that bears inversion "
        "(StableNeoHookean) may help"
    )
