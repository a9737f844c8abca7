"""Time integration, and static equilibrium."""

from warpfem.solvers.backward_euler import BackwardEuler
from warpfem.solvers.base import Solver, Stepper, StepReport
from warpfem.solvers.explicit import SymplecticEuler, VelocityVerlet
from warpfem.solvers.quasistatic import Quasistatic
from warpfem.solvers.runge_kutta import SDIRK2, SDIRK3, ImplicitMidpoint
from warpfem.solvers.static import StaticEquilibrium

SOLVERS: dict[str, type[Solver]] = {
    solver.name: solver
    for solver in (SymplecticEuler, VelocityVerlet, BackwardEuler, ImplicitMidpoint, SDIRK2, SDIRK3, Quasistatic)
}
"""The solvers by name."""

__all__ = [
    "SDIRK2",
    "SDIRK3",
    "SOLVERS",
    "BackwardEuler",
    "ImplicitMidpoint",
    "Quasistatic",
    "Solver",
    "StaticEquilibrium",
    "StepReport",
    "Stepper",
    "SymplecticEuler",
    "VelocityVerlet",
]
