"""Linear systems of the tangent: operators A = w M + K(u) + contact, and what solves A x = b."""

from warpfem.linear.conjugate_gradients import (
    BlockJacobi,
    ConjugateGradients,
    LinearResult,
    LinearStatus,
    Preconditioner,
)
from warpfem.linear.operators import AssembledOperator, Hessian, TangentOperator, tangent_operator
from warpfem.linear.solver import METHODS, LinearMethod, LinearSolver

__all__ = [
    "METHODS",
    "AssembledOperator",
    "BlockJacobi",
    "ConjugateGradients",
    "Hessian",
    "LinearMethod",
    "LinearResult",
    "LinearSolver",
    "LinearStatus",
    "Preconditioner",
    "TangentOperator",
    "tangent_operator",
]
