"""Backward Euler: converged, or as the lecture's single linear solve."""

from dataclasses import dataclass

import warp as wp

from warpfem.linear import Hessian
from warpfem.model import Model, Route, State
from warpfem.solvers.base import Stepper, StepReport, require_tolerance
from warpfem.solvers.implicit import ImplicitSolver, ImplicitStepper, Tableau


@dataclass(frozen=True)
class BackwardEuler(ImplicitSolver):
    """Backward Euler, v = (u - u_t)/dt and M (v - v_t)/dt = f(u) at the end of the step.

    By default each step is solved to ``tolerance`` by Newton's method with line search on the incremental
    potential. :meth:`linearised` is the lecture's single linear solve, taken with ``max_iterations=1``.

    Attributes:
        linear_tolerance: relative residual of the linear solve of a linearised step.
    """

    linear_tolerance: float = 1e-5

    name = "backward_euler"
    order = 1
    tableau = Tableau(rows=((1.0,),))
    least_iterations = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        require_tolerance(self, "linear_tolerance")

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
        return _LinearisedStepper(model, self) if self.max_iterations == 1 else ImplicitStepper(model, self)


class _LinearisedStepper(ImplicitStepper):
    config: BackwardEuler

    def _solve(self, state: State, acceleration: wp.array | None, time: float) -> StepReport:
        contact, potential = self.model.contact, self.newton.potential
        if contact is not None:
            potential.add_scaled(state.u, 1.0, potential.predicted, potential.part)
            contact.linearize_friction(state.u, potential.duration, potential.part)
        return self.newton.solve_once(self.config.linear_tolerance, time)
