"""What solves the linear systems of a model: the choice of a method, and how long a preconditioner is kept."""

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal, TypeAlias

import numpy as np
import warp as wp

from warpfem.errors import SceneError
from warpfem.linear.conjugate_gradients import (
    BlockJacobi,
    ConjugateGradients,
    LinearResult,
    LinearStatus,
    Preconditioner,
    RenewedPreconditioner,
)
from warpfem.linear.operators import AssembledOperator, TangentOperator
from warpfem.model import Model

LinearMethod: TypeAlias = Literal["auto", "conjugate_gradients", "multigrid", "cholesky"]

METHODS = ("auto", "conjugate_gradients", "multigrid", "cholesky")

MOST_FACTORED = {2: 1_000_000, 3: 120_000}
"""Unknowns, by dimension, up to which a factor costs less than multigrid (``benchmarks/linear_solvers.py``)."""

MOST_FACTORED_LOCKED = {2: 1_000_000, 3: 400_000}
"""The same for nearly incompressible bodies, with which multigrid needs many times the iterations."""

SMALL = 3000
"""Unknowns up to which an equilibrium may be found before the library of the factor is loaded (0.3 to 0.6 s)."""

LOCKED = 0.45
"""Poisson's ratio from which bodies count as nearly incompressible."""

EASY = {"cholesky": 100, "multigrid": 400}
"""Iterations of conjugate gradients with block Jacobi that cost about what the set-up of the other method does."""

PATIENCE = {"cholesky": 10, "multigrid": 60}
"""Iterations of one solve that cost about what a new factor or hierarchy does: more, and it has aged."""

CURVED = 100
"""Iterations that look for a descent direction where a factor has shown that the matrix is not positive definite."""

_PACKAGES = {"cholesky": "pypardiso", "multigrid": "pyamg"}


@dataclass(frozen=True)
class LinearChoice:
    """How linear systems are solved.

    Attributes:
        first: the method to begin with.
        then: the method to go on with where one solve takes more than ``EASY`` iterations, or ``None``.
        reason: why.
    """

    first: str
    then: str | None
    reason: str


def choose(model: Model, method: LinearMethod, assembled: bool, static: bool) -> LinearChoice:
    """The choice for a model.

    Args:
        model: the model.
        method: what is asked for.
        assembled: whether the tangent is.
        static: whether inertia is absent.

    Raises:
        SceneError: what is asked for is not installed.
    """
    unknowns = model.dim * model.point_count
    if method in _PACKAGES:
        _require_installed(method)
    if method != "auto":
        return LinearChoice(method, None, "as asked for")
    if not assembled:
        return LinearChoice("conjugate_gradients", None, "the tangent is not assembled")
    locked = _poisson_ratio(model) >= LOCKED
    most = (MOST_FACTORED_LOCKED if locked else MOST_FACTORED)[model.dim]
    then = "cholesky" if unknowns <= most else "multigrid"
    if find_spec(_PACKAGES["cholesky"]) is None and find_spec(_PACKAGES["multigrid"]) is not None and not locked:
        then = "multigrid"  # as where there is no PARDISO
    size = f"{unknowns} unknowns in {model.dim}D" + (", nearly incompressible" if locked else "")
    if find_spec(_PACKAGES[then]) is None:
        return LinearChoice(
            "conjugate_gradients", None, f"{then} would suit {size}, but {_PACKAGES[then]} is not installed: {_INSTALL}"
        )
    bound = f"{'at most' if unknowns <= most else 'more than'} {most}"
    if static and unknowns > SMALL:
        return LinearChoice(then, None, f"no inertia, and {size}, {bound}")
    return LinearChoice(
        "conjugate_gradients",
        then,
        f"{then}, for {size}, {bound}, once a solve takes more than {EASY[then]} iterations",
    )


_INSTALL = "pip install 'warpfem[solvers]'"


def _require_installed(method: str) -> None:
    if find_spec(_PACKAGES[method]) is None:
        raise SceneError(f"linear_solver={method!r} needs {_PACKAGES[method]}: {_INSTALL}")


def _poisson_ratio(model: Model) -> float:
    """The largest of the bodies' that have one; averaged cells resist the change of volume by themselves too."""
    return max(float(np.max(getattr(body.material, "nu", 0.0))) for body in model.scene.bodies)


def _strong(method: str, operator: AssembledOperator) -> RenewedPreconditioner:
    if method == "cholesky":
        from warpfem.linear.factor import SparseFactor

        return SparseFactor(operator)
    from warpfem.linear.multigrid import Multigrid

    return Multigrid(operator)


class LinearSolver:
    """Solves A x = b for the tangents of one operator.

    A factor or a hierarchy is that of an earlier tangent, with which conjugate gradients solve for the present one,
    until it takes them more than ``PATIENCE`` iterations.

    Args:
        operator: A.
        method: what is asked for.
        static: whether inertia is absent.
        watchful: whether negative curvature that the right-hand side feels must not go unnoticed.

    Attributes:
        choice: the method to begin with, and why.
        method: the method now.
    """

    def __init__(self, operator: TangentOperator, method: LinearMethod, static: bool, watchful: bool = False) -> None:
        self.operator = operator
        assembled = isinstance(operator, AssembledOperator)
        self.choice = choose(operator.model, method, assembled, static)
        self.method = self.choice.first
        self._cg = ConjugateGradients(operator.model)
        self._jacobi = BlockJacobi(operator)
        self._strong: RenewedPreconditioner | None = None
        self._aged = False
        self._watchful = watchful

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        return [*self._cg.arrays(), *([] if self._strong is None else self._strong.arrays())]

    @property
    def direction(self):
        """The last search direction of conjugate gradients and its product with A, float64 copies."""
        return self._cg.direction

    def __str__(self) -> str:
        words = {"conjugate_gradients": "conjugate gradients with block Jacobi", "cholesky": "sparse Cholesky"}
        return f"{words.get(self.method, self.method)} ({self.choice.reason})"

    def forget(self) -> None:
        """Solves as if for the first time, so that a run that is taken up again has the same bits."""
        self.method = self.choice.first
        self._aged = True

    def definite(self, shift: float) -> bool | None:
        """Whether A + shift D is positive definite, D its diagonal blocks; ``None`` where no factor tells."""
        if self.method != "cholesky":
            return None
        if self._strong is None:
            self._strong = _strong(self.method, self.operator)
        self._aged = not self._strong.update(shift)
        return not self._aged

    def solve(self, b: wp.array, x: wp.array, *, tolerance: float, max_iterations: int) -> LinearResult:
        """Solves A x = b from x = 0 until |b - A x| <= tolerance |b|; overwrites ``x``.

        Args:
            b: right-hand side, zero where held.
            x: the solution.
            tolerance: relative residual to reach.
            max_iterations: limit of iterations.
        """
        before = 0
        if self.method == "conjugate_gradients":
            then = self.choice.then
            limit = max_iterations if then is None else min(EASY[then], max_iterations)
            result = self._iterate(self._jacobi, b, x, tolerance, limit)
            if then is None or result.status is not LinearStatus.ITERATIONS or limit == max_iterations:
                return result
            self.method, before = then, result.iterations
        return self._solve_strongly(b, x, tolerance, max_iterations - before, before)

    def _solve_strongly(
        self, b: wp.array, x: wp.array, tolerance: float, max_iterations: int, before: int
    ) -> LinearResult:
        """By the factor or hierarchy at hand, or a new one where it has aged.

        ``before`` counts iterations done, from whose end this one starts.
        """
        fresh = self._strong is None or self._aged or (self._watchful and self.method == "cholesky")
        if fresh and not self._renew():
            return self._without_factor(b, x, tolerance, max_iterations, before)
        patience = PATIENCE[self.method]
        limit = max_iterations if fresh else min(2 * patience, max_iterations)
        result = self._iterate(self._strong, b, x, tolerance, limit, before)
        self._aged = result.iterations - before > patience
        if result.status is LinearStatus.ITERATIONS and limit < max_iterations:
            return self._solve_strongly(b, x, tolerance, max_iterations - limit, result.iterations)
        return result

    def _iterate(
        self, preconditioner: Preconditioner, b: wp.array, x: wp.array, tolerance: float, limit: int, before: int = 0
    ) -> LinearResult:
        result = self._cg.solve(
            self.operator, preconditioner, b, x, tolerance=tolerance, max_iterations=limit, onward=before > 0
        )
        return LinearResult(before + result.iterations, result.residual, result.status)

    def _renew(self) -> bool:
        """Makes the factor or hierarchy that of the present tangent; returns whether that is positive definite."""
        if self._strong is None:
            self._strong = _strong(self.method, self.operator)
        self._aged = not self._strong.update()
        return not self._aged

    def _without_factor(
        self, b: wp.array, x: wp.array, tolerance: float, max_iterations: int, before: int
    ) -> LinearResult:
        """A descent direction for a matrix that is not positive definite.

        Where it matters whether this right-hand side feels that, conjugate gradients tell.
        """
        limit = max_iterations if self._watchful else min(CURVED, max_iterations)
        result = self._iterate(self._jacobi, b, x, tolerance, limit)
        status = result.status if self._watchful else LinearStatus.CURVATURE
        return LinearResult(before + result.iterations, result.residual, status)
