"""Linear systems of the tangent: operators A = w M + K(u) + contact, and what solves A x = b."""

from warpfem.linear.conjugate_gradients import (
    BlockJacobi,
    ConjugateGradients,
    LinearResult,
    LinearStatus,
    Preconditioner,
)
from warpfem.linear.operators import AssembledOperator, Hessian, TangentOperator, tangent_operator

__all__ = [
    "AssembledOperator",
    "BlockJacobi",
    "ConjugateGradients",
    "Hessian",
    "LinearResult",
    "LinearStatus",
    "Preconditioner",
    "TangentOperator",
    "tangent_operator",
]
