"""Preconditioned conjugate gradients for the tangent operators of a model."""

import functools
from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import Enum
from functools import partial
from types import SimpleNamespace

import numpy as np
import warp as wp

from warpfem.dtypes import types
from warpfem.launches import Launcher
from warpfem.linear.operators import TangentOperator
from warpfem.model import Model
from warpfem.points import CHUNK, LANES, chunks, entry_functions

PROGRESS = 0.5
"""A new start from the true residual that leaves more than this part of it shows that rounding hides the rest."""

# Entries of the float64 array of scalars that conjugate gradients keep on the device.
_RHO = wp.constant(0)  # r . z
_CURVATURE = wp.constant(1)  # p . A p
_RESIDUAL = wp.constant(2)  # r . r
_ALPHA = wp.constant(3)
_BETA = wp.constant(4)


class LinearStatus(Enum):
    """How a linear solve ended."""

    CONVERGED = "converged"
    ROUNDED = "stopped at the rounding of the residual"
    ITERATIONS = "stopped at the iteration limit"
    CURVATURE = "met a direction of negative curvature"


@dataclass(frozen=True)
class LinearResult:
    """Result of a linear solve.

    Attributes:
        iterations: iterations done.
        residual: |b - A x| / |b|, computed from x.
        status: how it ended.
    """

    iterations: int
    residual: float
    status: LinearStatus


class Preconditioner(ABC):
    """A symmetric positive definite B that resembles the inverse of A.

    Attributes:
        on_device: whether :meth:`apply` launches kernels alone, so that a graph can hold it.
        version: changes when the arrays do that :meth:`apply` takes.
    """

    on_device = True
    version = 0

    @abstractmethod
    def apply(self, r: wp.array, z_out: wp.array) -> None:
        """Writes B r."""

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        return []


class RenewedPreconditioner(Preconditioner):
    """One that is costly to set up, and so kept for tangents after the one that it was made for."""

    @abstractmethod
    def update(self) -> bool:
        """Makes it that of the present tangent; returns whether that is positive definite, and it of use."""


class BlockJacobi(Preconditioner):
    """The inverse of each point's diagonal block."""

    def __init__(self, operator: TangentOperator) -> None:
        self._operator = operator
        self._kernel = _kernels(operator.model.dim, operator.model.dtype, operator.model.device.is_cpu).multiply_blocks
        self._launch = Launcher(operator.model.device)

    def apply(self, r: wp.array, z_out: wp.array) -> None:
        inputs = [self._operator.inverse_diagonal, r]
        self._launch(self._kernel, r.shape[0], inputs, [z_out])


class ConjugateGradients:
    """Preconditioned conjugate gradients (Hestenes and Stiefel 1952).

    Stops early at a direction of negative curvature with what it has, which is a descent direction for
    Newton's method (Nocedal and Wright 2006, algorithm 7.1).

    The residual that the recursion keeps drifts from b - A x by rounding. Where it meets the tolerance, the true one
    is computed, and the iteration starts again from that, as long as it helps.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self._kernels = _kernels(model.dim, model.dtype, model.device.is_cpu)
        self._tasks = chunks(model.point_count) if model.device.is_cpu else model.point_count
        self._r, self._z, self._p, self._q = (model.zeros() for _ in range(4))
        self._parts = wp.zeros((2, chunks(model.point_count)), dtype=wp.float64, device=model.device)
        self._scalars = wp.zeros(5, dtype=wp.float64, device=model.device)
        self._view = self._scalars.numpy() if model.device.is_cpu else None
        self._graph: tuple | None = None
        self._launcher = Launcher(model.device)

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        return [self._r, self._z, self._p, self._q, self._parts, self._scalars]

    @property
    def direction(self) -> tuple[np.ndarray, np.ndarray]:
        """The last search direction p and its product A p, float64 copies (point_count, dim)."""
        return self._p.numpy().astype(np.float64), self._q.numpy().astype(np.float64)

    def solve(
        self,
        operator: TangentOperator,
        preconditioner: Preconditioner,
        b: wp.array,
        x: wp.array,
        *,
        tolerance: float,
        max_iterations: int,
        onward: bool = False,
    ) -> LinearResult:
        """Solves A x = b until |b - A x| <= tolerance |b|.

        Args:
            operator: A.
            preconditioner: B.
            b: right-hand side, zero where held.
            x: the solution.
            tolerance: relative residual to reach.
            max_iterations: limit of iterations.
            onward: whether to start from ``x`` rather than from zero.
        """
        if not onward:
            x.zero_()
        size = self.model.dot(b, b) ** 0.5
        if size == 0.0:
            x.zero_()
            return LinearResult(0, 0.0, LinearStatus.CONVERGED)
        wp.copy(self._r, b)
        residual = size
        if onward:
            residual = self._true_residual(operator, b, x)
        iterations = 0
        while True:
            limit = max_iterations - iterations
            done, status = self._iterate(operator, preconditioner, x, tolerance * size, limit, iterations == 0)
            iterations += done
            last, residual = residual, self._true_residual(operator, b, x)
            if status is LinearStatus.CONVERGED and not residual <= tolerance * size:
                status = None if residual <= PROGRESS * last else LinearStatus.ROUNDED
            if status is not None:
                return LinearResult(iterations, residual / size, status)

    def _true_residual(self, operator: TangentOperator, b: wp.array, x: wp.array) -> float:
        """Writes b - A x to the residual; returns its norm."""
        operator.subtract_product(b, x, self._r)
        return self.model.dot(self._r, self._r) ** 0.5

    def _iterate(
        self,
        operator: TangentOperator,
        preconditioner: Preconditioner,
        x: wp.array,
        target: float,
        max_iterations: int,
        alone: bool,
    ) -> tuple[int, LinearStatus]:
        """Iterates from the residual until the recursion has it at the target.

        Args:
            operator, preconditioner, x: as for :meth:`solve`.
            target: norm of the residual to reach.
            max_iterations: limit.
            alone: whether x may be replaced by the first direction, if that has negative curvature.

        Returns:
            The iterations, and how they ended.
        """
        preconditioner.apply(self._r, self._z)
        self._scalars.zero_()
        self._launch_chunks("measure", [self._r, self._z], [self._parts])
        self._launch_once("start", [self._parts], [self._scalars])
        wp.copy(self._p, self._z)
        if self._scalar(_RESIDUAL) ** 0.5 <= target:
            return 0, LinearStatus.CONVERGED
        for iteration in range(max_iterations):
            if self._graph is None and iteration == 0:  # which loads the kernels
                self._launch_iteration(operator, preconditioner, x)
            else:
                self._replay(operator, preconditioner, x)
            if not self._scalar(_CURVATURE) > 0.0:
                if iteration == 0 and alone:
                    wp.copy(x, self._p)  # the preconditioned right-hand side still descends
                return iteration, LinearStatus.CURVATURE
            if self._scalar(_RESIDUAL) ** 0.5 <= target:
                return iteration + 1, LinearStatus.CONVERGED
        return max_iterations, LinearStatus.ITERATIONS

    def _launch_iteration(self, operator: TangentOperator, preconditioner: Preconditioner, x: wp.array) -> None:
        operator.apply(self._p, self._q)
        self._launch_update(preconditioner, x)

    def _launch_update(self, preconditioner: Preconditioner, x: wp.array) -> None:
        """What follows the product q = A p."""
        r, z, p, q, scalars = self._r, self._z, self._p, self._q, self._scalars
        self._launch_chunks("curvature", [p, q], [self._parts])
        self._launch_once("choose_step", [self._parts], [scalars])
        self._launch("advance", [p, q, scalars], [x, r])
        preconditioner.apply(r, z)
        self._launch_chunks("measure", [r, z], [self._parts])
        self._launch_once("choose_turn", [self._parts], [scalars])
        self._launch("turn", [z, scalars], [p])

    def _replay(self, operator: TangentOperator, preconditioner: Preconditioner, x: wp.array) -> None:
        """An iteration, from a graph of its kernels where one can be captured: a tenth of the cost of launches."""
        if not (operator.fixed and preconditioner.on_device):
            self._launch_iteration(operator, preconditioner, x)
            return
        parties = operator, preconditioner, x  # held by the graph, so that no other gets their ids
        key = (*map(id, parties), preconditioner.version)
        if self._graph is None or self._graph[0] != key:
            launch = self._launch_update if operator.divided else partial(self._launch_iteration, operator)
            with wp.ScopedCapture(device=self.model.device) as capture:
                launch(preconditioner, x)
            self._graph = key, parties, capture.graph
        if operator.divided:
            operator.apply(self._p, self._q)
        wp.capture_launch(self._graph[2])

    def _scalar(self, index: int) -> float:
        values = self._scalars.numpy() if self._view is None else self._view
        return float(values[index])

    def _launch(self, name: str, inputs: list, outputs: list) -> None:
        self._launch_tasks(name, self._tasks, inputs, outputs)

    def _launch_chunks(self, name: str, inputs: list, outputs: list) -> None:
        self._launch_tasks(name, chunks(self.model.point_count), inputs, outputs)

    def _launch_once(self, name: str, inputs: list, outputs: list) -> None:
        self._launch_tasks(name, 1, inputs, outputs)

    def _launch_tasks(self, name: str, tasks: int, inputs: list, outputs: list) -> None:
        self._launcher(getattr(self._kernels, name), tasks, inputs, outputs)


@functools.cache
def _kernels(dim: int, dtype: str, on_cpu: bool) -> SimpleNamespace:
    """Vector kernels of conjugate gradients. Sums are of parts, each of one chunk, so that their order is fixed.

    Args:
        dim: components of a point's vector.
        dtype: "float32" or "float64".
        on_cpu: whether for the CPU, where a task of few points would cost more than their work.
    """
    t = types(dim, dtype)
    vector, matrix, scalar = t.vector, t.matrix, t.scalar
    module = f"warpfem.conjugate_gradients_{dim}_{dtype}{'' if on_cpu else '_gpu'}"
    span = CHUNK if on_cpu else 1

    functions = entry_functions(dim, dtype)
    flat, inner = functions.flat, functions.inner

    @wp.func
    def add_multiple(factor: scalar, a: wp.array(dtype=scalar), out: wp.array(dtype=scalar), start: int, count: int):
        """Adds factor a to a range of entries."""
        rounds = count // LANES
        for k in range(rounds):
            for lane in range(LANES):
                i = start + k * LANES + lane
                out[i] = out[i] + factor * a[i]
        for rest in range(start + rounds * LANES, start + count):
            out[rest] = out[rest] + factor * a[rest]

    @wp.func
    def replace_multiple(
        factor: scalar, a: wp.array(dtype=scalar), out: wp.array(dtype=scalar), start: int, count: int
    ):
        """Writes a plus factor times what was there to a range of entries."""
        rounds = count // LANES
        for k in range(rounds):
            for lane in range(LANES):
                i = start + k * LANES + lane
                out[i] = a[i] + factor * out[i]
        for rest in range(start + rounds * LANES, start + count):
            out[rest] = a[rest] + factor * out[rest]

    @wp.func
    def total(parts: wp.array2d(dtype=wp.float64), row: int):
        result = wp.float64(0.0)
        for k in range(parts.shape[1]):
            result += parts[row, k]
        return result

    @wp.kernel(module=module, enable_backward=False)
    def multiply_blocks(blocks: wp.array(dtype=matrix), p: wp.array(dtype=vector), product_out: wp.array(dtype=vector)):
        """Writes the product of a block per point with p."""
        i = wp.tid()
        product_out[i] = blocks[i] * p[i]

    @wp.kernel(module=module, enable_backward=False)
    def curvature(p: wp.array(dtype=vector), q: wp.array(dtype=vector), parts_out: wp.array2d(dtype=wp.float64)):
        """Parts of p . A p."""
        chunk = wp.tid()
        first = chunk * CHUNK
        count = wp.min(CHUNK, p.shape[0] - first)
        parts_out[0, chunk] = inner(flat(p), flat(q), first * dim, count * dim)

    @wp.kernel(module=module, enable_backward=False)
    def choose_step(parts: wp.array2d(dtype=wp.float64), scalars_out: wp.array(dtype=wp.float64)):
        """alpha = r . z / p . A p; 0 at a direction of negative curvature."""
        result = total(parts, 0)
        scalars_out[_CURVATURE] = result
        alpha = wp.float64(0.0)
        if result > wp.float64(0.0):
            alpha = scalars_out[_RHO] / result
        scalars_out[_ALPHA] = alpha

    @wp.kernel(module=module, enable_backward=False)
    def advance(
        p: wp.array(dtype=vector),
        q: wp.array(dtype=vector),
        scalars: wp.array(dtype=wp.float64),
        x_out: wp.array(dtype=vector),
        r_out: wp.array(dtype=vector),
    ):
        """x += alpha p, r -= alpha A p."""
        first = wp.tid() * span
        count = wp.min(span, p.shape[0] - first)
        alpha = scalar(scalars[_ALPHA])
        add_multiple(alpha, flat(p), flat(x_out), first * dim, count * dim)
        add_multiple(-alpha, flat(q), flat(r_out), first * dim, count * dim)

    @wp.kernel(module=module, enable_backward=False)
    def measure(r: wp.array(dtype=vector), z: wp.array(dtype=vector), parts_out: wp.array2d(dtype=wp.float64)):
        """Parts of r . z and r . r."""
        chunk = wp.tid()
        first = chunk * CHUNK
        count = wp.min(CHUNK, r.shape[0] - first)
        parts_out[0, chunk] = inner(flat(r), flat(z), first * dim, count * dim)
        parts_out[1, chunk] = inner(flat(r), flat(r), first * dim, count * dim)

    @wp.kernel(module=module, enable_backward=False)
    def start(parts: wp.array2d(dtype=wp.float64), scalars_out: wp.array(dtype=wp.float64)):
        """r . z and r . r."""
        scalars_out[_RHO] = total(parts, 0)
        scalars_out[_RESIDUAL] = total(parts, 1)

    @wp.kernel(module=module, enable_backward=False)
    def choose_turn(parts: wp.array2d(dtype=wp.float64), scalars_out: wp.array(dtype=wp.float64)):
        """beta, the next r . z over the last, and r . r."""
        rho = total(parts, 0)
        scalars_out[_BETA] = rho / scalars_out[_RHO]
        scalars_out[_RHO] = rho
        scalars_out[_RESIDUAL] = total(parts, 1)

    @wp.kernel(module=module, enable_backward=False)
    def turn(z: wp.array(dtype=vector), scalars: wp.array(dtype=wp.float64), p_out: wp.array(dtype=vector)):
        """p = z + beta p, unless p has negative curvature."""
        first = wp.tid() * span
        count = wp.min(span, z.shape[0] - first)
        if scalars[_CURVATURE] > wp.float64(0.0):
            replace_multiple(scalar(scalars[_BETA]), flat(z), flat(p_out), first * dim, count * dim)

    return SimpleNamespace(**{name: kernel for name, kernel in locals().items() if isinstance(kernel, wp.Kernel)})
