"""Time integration."""

from warpfem.solvers.base import Solver, Stepper, StepReport
from warpfem.solvers.explicit import SymplecticEuler, VelocityVerlet
from warpfem.solvers.implicit import BackwardEuler

SOLVERS: dict[str, type[Solver]] = {solver.name: solver for solver in (SymplecticEuler, VelocityVerlet, BackwardEuler)}
"""The solvers by name."""

__all__ = ["SOLVERS", "BackwardEuler", "Solver", "StepReport", "Stepper", "SymplecticEuler", "VelocityVerlet"]
