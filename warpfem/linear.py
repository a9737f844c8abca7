"""Tangent operators A = w M + K(u) + contact, by three routes, and conjugate gradients.

The three routes to the stiffness product K p (Hu 2020, force differentials): ``wp.Tape`` replays the force
kernel backwards, because K is symmetric; the closed form evaluates each material's stress differential; the
assembled route stores K as d x d blocks in compressed rows, whose pattern is found once from the topology.
"""

import functools
from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import Enum
from types import SimpleNamespace
from typing import Literal, TypeAlias

import numpy as np
import warp as wp

from warpfem.dtypes import types
from warpfem.elements import Filter
from warpfem.errors import SimulationError
from warpfem.model import CellBlock, Model, Route
from warpfem.points import CHUNK, chunks
from warpfem.tensor import is_positive_definite

Hessian: TypeAlias = Literal["exact", Filter]

# Entries of the float64 array of scalars that conjugate gradients keep on the device.
_RHO = wp.constant(0)  # r . z
_CURVATURE = wp.constant(1)  # p . A p
_NEXT_RHO = wp.constant(2)
_RESIDUAL = wp.constant(3)  # r . r


@functools.cache
def operator_kernels(dim: int, dtype: str) -> SimpleNamespace:
    """The kernels that put operators together and apply them."""
    t = types(dim, dtype)
    vector, matrix, scalar = t.vector, t.matrix, t.scalar
    module = f"warpfem.operators_{dim}_{dtype}"

    @wp.kernel(module=module, enable_backward=False)
    def add_mass(
        mass: wp.array(dtype=scalar),
        weight: scalar,
        diagonal: wp.array(dtype=wp.int32),
        blocks_out: wp.array(dtype=matrix),
    ):
        """Adds weight m_i I to the diagonal block of each point."""
        i = wp.tid()
        blocks_out[diagonal[i]] += (weight * mass[i]) * wp.identity(n=dim, dtype=scalar)

    @wp.kernel(module=module, enable_backward=False)
    def add_blocks(
        blocks: wp.array(dtype=matrix), diagonal: wp.array(dtype=wp.int32), blocks_out: wp.array(dtype=matrix)
    ):
        """Adds a block per point to the diagonal blocks."""
        i = wp.tid()
        blocks_out[diagonal[i]] += blocks[i]

    @wp.kernel(module=module, enable_backward=False)
    def invert_diagonal(
        blocks: wp.array(dtype=matrix),
        diagonal: wp.array(dtype=wp.int32),
        inverse_out: wp.array(dtype=matrix),
    ):
        """Inverts the diagonal block of each point, or its mean, where it is not positive definite."""
        i = wp.tid()
        block = blocks[diagonal[i]]
        inverse = wp.identity(n=dim, dtype=scalar)
        scale = wp.trace(block) / scalar(float(dim))
        if scale > scalar(0.0):
            relative = block / scale
            if is_positive_definite(relative) and wp.determinant(relative) > scalar(1.0e-12):
                inverse = wp.inverse(relative) / scale
            else:
                inverse = wp.identity(n=dim, dtype=scalar) / scale
        inverse_out[i] = inverse

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        row_starts: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        blocks: wp.array(dtype=matrix),
        p: wp.array(dtype=vector),
        product_out: wp.array(dtype=vector),
    ):
        """Writes the product of a block-sparse matrix with p."""
        i = wp.tid()
        total = vector()
        for slot in range(row_starts[i], row_starts[i + 1]):
            total += blocks[slot] * p[columns[slot]]
        product_out[i] = total

    @wp.kernel(module=module, enable_backward=False)
    def multiply_mass(
        mass: wp.array(dtype=scalar),
        weight: scalar,
        p: wp.array(dtype=vector),
        product_out: wp.array(dtype=vector),
    ):
        """Writes weight M p."""
        i = wp.tid()
        product_out[i] = (weight * mass[i]) * p[i]

    @wp.kernel(module=module, enable_backward=False)
    def add_block_product(
        blocks: wp.array(dtype=matrix), p: wp.array(dtype=vector), product_out: wp.array(dtype=vector)
    ):
        """Adds the product of a block per point with p."""
        i = wp.tid()
        product_out[i] += blocks[i] * p[i]

    @wp.kernel(module=module, enable_backward=False)
    def subtract(a: wp.array(dtype=vector), difference_out: wp.array(dtype=vector)):
        """Subtracts a."""
        i = wp.tid()
        difference_out[i] -= a[i]

    return SimpleNamespace(**{k: v for k, v in locals().items() if isinstance(v, wp.Kernel)})


@functools.cache
def _gradient_kernels(dim: int, dtype: str) -> SimpleNamespace:
    """The fused vector kernels of conjugate gradients."""
    t = types(dim, dtype)
    vector, matrix, scalar = t.vector, t.matrix, t.scalar
    module = f"warpfem.conjugate_gradients_{dim}_{dtype}"

    @wp.func
    def inner(a: vector, b: vector):
        total = wp.float64(0.0)
        for k in range(dim):
            total += wp.float64(a[k]) * wp.float64(b[k])
        return total

    @wp.kernel(module=module, enable_backward=False)
    def start(
        b: wp.array(dtype=vector),
        preconditioner: wp.array(dtype=matrix),
        r_out: wp.array(dtype=vector),
        p_out: wp.array(dtype=vector),
        scalars_out: wp.array(dtype=wp.float64),
    ):
        """For x = 0: r = b, p = B r."""
        first = wp.tid() * CHUNK
        last = wp.min(first + CHUNK, b.shape[0])
        rho = wp.float64(0.0)
        residual = wp.float64(0.0)
        for i in range(first, last):
            r = b[i]
            z = preconditioner[i] * r
            r_out[i] = r
            p_out[i] = z
            rho += inner(r, z)
            residual += inner(r, r)
        wp.atomic_add(scalars_out, _NEXT_RHO, rho)
        wp.atomic_add(scalars_out, _RESIDUAL, residual)

    @wp.kernel(module=module, enable_backward=False)
    def prepare(scalars_out: wp.array(dtype=wp.float64)):
        """Makes the next r . z the current one and clears the sums."""
        scalars_out[_RHO] = scalars_out[_NEXT_RHO]
        scalars_out[_CURVATURE] = wp.float64(0.0)
        scalars_out[_NEXT_RHO] = wp.float64(0.0)
        scalars_out[_RESIDUAL] = wp.float64(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def curvature(p: wp.array(dtype=vector), q: wp.array(dtype=vector), scalars_out: wp.array(dtype=wp.float64)):
        """Sums p . A p."""
        first = wp.tid() * CHUNK
        last = wp.min(first + CHUNK, p.shape[0])
        total = wp.float64(0.0)
        for i in range(first, last):
            total += inner(p[i], q[i])
        wp.atomic_add(scalars_out, _CURVATURE, total)

    @wp.kernel(module=module, enable_backward=False)
    def advance(
        p: wp.array(dtype=vector),
        q: wp.array(dtype=vector),
        preconditioner: wp.array(dtype=matrix),
        x_out: wp.array(dtype=vector),
        r_out: wp.array(dtype=vector),
        z_out: wp.array(dtype=vector),
        scalars_out: wp.array(dtype=wp.float64),
    ):
        """x += alpha p, r -= alpha A p, z = B r."""
        first = wp.tid() * CHUNK
        last = wp.min(first + CHUNK, p.shape[0])
        alpha = scalar(scalars_out[_RHO] / scalars_out[_CURVATURE])
        rho = wp.float64(0.0)
        residual = wp.float64(0.0)
        for i in range(first, last):
            x_out[i] += alpha * p[i]
            r = r_out[i] - alpha * q[i]
            z = preconditioner[i] * r
            r_out[i] = r
            z_out[i] = z
            rho += inner(r, z)
            residual += inner(r, r)
        wp.atomic_add(scalars_out, _NEXT_RHO, rho)
        wp.atomic_add(scalars_out, _RESIDUAL, residual)

    @wp.kernel(module=module, enable_backward=False)
    def turn(z: wp.array(dtype=vector), scalars: wp.array(dtype=wp.float64), p_out: wp.array(dtype=vector)):
        """p = z + beta p."""
        i = wp.tid()
        beta = scalar(scalars[_NEXT_RHO] / scalars[_RHO])
        p_out[i] = z[i] + beta * p_out[i]

    return SimpleNamespace(start=start, prepare=prepare, curvature=curvature, advance=advance, turn=turn)


class TangentOperator(ABC):
    """A = w M + K(u), with the model's contact and supports when ``external``.

    :meth:`linearize` takes u and w; :meth:`apply` then multiplies. Held components are those of the identity,
    so that a right-hand side that is zero there stays zero.

    Attributes:
        inverse_diagonal: inverse of each point's diagonal block: the block Jacobi preconditioner. Valid
            after ``linearize(..., precondition=True)``.
    """

    def __init__(self, model: Model, external: bool) -> None:
        self.model = model
        self.kernels = operator_kernels(model.dim, model.dtype)
        self.hessian: Hessian = "exact"
        self.supports = model.supports if external else None
        self.contact = model.contact if external else None
        self.averaged = [block for block in model.blocks if block.averaged]
        self.inverse_diagonal: wp.array | None = None
        self.diagonal: wp.array
        self.contact_blocks = self._new_blocks(model.point_count) if self.contact is not None else None

    @abstractmethod
    def linearize(
        self,
        u: wp.array,
        mass_weight: float,
        *,
        hessian: Hessian = "exact",
        friction: tuple[wp.array, float] | None = None,
        precondition: bool = False,
    ) -> None:
        """Takes the tangent at ``u``.

        Args:
            u: displacements, device array.
            mass_weight: w [1/s^2].
            hessian: what becomes of the negative eigenvalues of each cell's stiffness: "exact" leaves them,
                "absolute" takes their absolute values, "clamped" zero.
            friction: start of the step and dt, if friction of a step is to be included.
            precondition: whether to compute :attr:`inverse_diagonal`.
        """

    @abstractmethod
    def apply(self, p: wp.array, product_out: wp.array) -> None:
        """Overwrites ``product_out`` with A p."""

    @abstractmethod
    def arrays(self) -> list[wp.array]:
        """The device arrays held."""

    def _kernel(self, name: str) -> str:
        return name if self.hessian == "exact" else f"{self.hessian}_{name}"

    def _new_blocks(self, count: int) -> wp.array:
        return wp.zeros(count, dtype=self.model.types.matrix, device=self.model.device)

    def _indices(self, data: np.ndarray) -> wp.array:
        return wp.array(data, dtype=wp.int32, device=self.model.device)

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.model.point_count, inputs=inputs, outputs=outputs, device=self.model.device)

    def _linearize_couplings(self, u: wp.array, friction: tuple[wp.array, float] | None) -> None:
        """Those of averaged cells, and contact."""
        for block in self.averaged:
            block.linearize(u)
        if self.contact is None:
            return
        self.contact_blocks.zero_()
        self.contact.add_blocks(u, self.contact_blocks)
        if friction is not None:
            self.contact.add_friction_blocks(*friction, u, self.contact_blocks)

    def _assemble(self, u: wp.array, slots: list[wp.array], mass_weight: float, blocks: wp.array) -> None:
        """Elements, mass and contact into ``blocks``, whose diagonal is at ``self.diagonal``."""
        blocks.zero_()
        for block, own in zip(self.model.blocks, slots, strict=True):
            block.launch(self._kernel("stiffness"), [u, own], [blocks])
        for block in self.averaged:
            block.add_coupling_diagonal(self.diagonal, blocks)
        if mass_weight > 0.0:
            self._launch(self.kernels.add_mass, [self.model.mass, mass_weight, self.diagonal], [blocks])
        if self.contact_blocks is not None:
            self._launch(self.kernels.add_blocks, [self.contact_blocks, self.diagonal], [blocks])

    def _invert_diagonal(self, blocks: wp.array) -> None:
        if self.inverse_diagonal is None:
            self.inverse_diagonal = self._new_blocks(self.model.point_count)
        self._launch(self.kernels.invert_diagonal, [blocks, self.diagonal], [self.inverse_diagonal])


class AssembledOperator(TangentOperator):
    """A stored as d x d blocks in compressed rows."""

    def __init__(self, model: Model, external: bool) -> None:
        super().__init__(model, external)
        row_starts, columns, slots = _block_pattern(model)
        diagonal = np.flatnonzero(columns == np.repeat(np.arange(model.point_count), np.diff(row_starts)))
        self.row_starts = self._indices(row_starts)
        self.columns = self._indices(columns)
        self.diagonal = self._indices(diagonal)
        self.slots = [self._indices(own) for own in slots]
        self.blocks = self._new_blocks(len(columns))

    def linearize(self, u, mass_weight, *, hessian="exact", friction=None, precondition=False) -> None:
        self.hessian = hessian
        self._linearize_couplings(u, friction)
        self._assemble(u, self.slots, mass_weight, self.blocks)
        if self.supports is not None:
            wp.launch(
                self.supports.kernels.hold_rows,
                self.supports.count,
                inputs=[self.supports.points, self.supports.held, self.row_starts, self.diagonal],
                outputs=[self.blocks],
                device=self.model.device,
            )
        if precondition:
            self._invert_diagonal(self.blocks)

    def apply(self, p, product_out) -> None:
        self._launch(self.kernels.multiply, [self.row_starts, self.columns, self.blocks, p], [product_out])
        for block in self.averaged:
            block.add_coupling(p, product_out, diagonal=False)  # its diagonal is in the blocks
        if self.averaged and self.supports is not None:
            self.supports.project(product_out)

    def arrays(self) -> list[wp.array]:
        optional = [self.contact_blocks, self.inverse_diagonal]
        return [
            self.row_starts,
            self.columns,
            self.diagonal,
            self.blocks,
            *self.slots,
            *(array for array in optional if array is not None),
        ]


class _UnassembledOperator(TangentOperator):
    """A whose product with K is computed from the elements each time."""

    def __init__(self, model: Model, external: bool) -> None:
        super().__init__(model, external)
        self.u: wp.array | None = None
        self.mass_weight = 0.0

    @abstractmethod
    def _add_stiffness_product(self, p: wp.array, product_out: wp.array) -> None: ...

    @functools.cached_property
    def _diagonal_blocks(self) -> tuple[wp.array, list[wp.array], wp.array]:
        # the elements' kernel leaves out the blocks whose slot is negative
        n = self.model.point_count
        slots = []
        for block in self.model.blocks:
            corners = block.shape.point_count
            own = np.full((block.count, corners, corners), -1, dtype=np.int32)
            own[:, range(corners), range(corners)] = block.host_cells
            slots.append(self._indices(own))
        self.diagonal = self._indices(np.arange(n))
        return self._new_blocks(n), slots, self._indices(np.arange(n + 1))

    def linearize(self, u, mass_weight, *, hessian="exact", friction=None, precondition=False) -> None:
        self.u = u
        self.hessian = hessian
        self.mass_weight = mass_weight
        self._linearize_couplings(u, friction)
        if precondition:
            blocks, slots, rows = self._diagonal_blocks
            self._assemble(u, slots, mass_weight, blocks)
            if self.supports is not None:
                wp.launch(
                    self.supports.kernels.hold_rows,
                    self.supports.count,
                    inputs=[self.supports.points, self.supports.held, rows, self.diagonal],
                    outputs=[blocks],
                    device=self.model.device,
                )
            self._invert_diagonal(blocks)

    def apply(self, p, product_out) -> None:
        if self.mass_weight > 0.0:
            self._launch(self.kernels.multiply_mass, [self.model.mass, self.mass_weight, p], [product_out])
        else:
            product_out.zero_()
        self._add_stiffness_product(p, product_out)
        if self.contact_blocks is not None:
            self._launch(self.kernels.add_block_product, [self.contact_blocks, p], [product_out])
        if self.supports is not None:
            self.supports.project(product_out)

    def arrays(self) -> list[wp.array]:
        own = [self.contact_blocks, self.inverse_diagonal]
        if "_diagonal_blocks" in self.__dict__:
            blocks, slots, rows = self._diagonal_blocks
            own += [blocks, *slots, rows, self.diagonal]
        return [array for array in own if array is not None]


class ClosedFormOperator(_UnassembledOperator):
    """A with K p from each material's stress differential in closed form."""

    def _add_stiffness_product(self, p, product_out) -> None:
        name = self._kernel("differential")
        for block in self.model.blocks:
            block.launch(name, [self.u, p], [product_out])
        for block in self.averaged:
            block.add_coupling(p, product_out, diagonal=True)


class TapeOperator(_UnassembledOperator):
    """A with K p from ``wp.Tape``: the adjoint of the force kernel, with p as the force's adjoint.

    A material whose stress Warp cannot differentiate puts its own differential on the tape.
    """

    def __init__(self, model: Model, external: bool) -> None:
        super().__init__(model, external)
        types_, device = model.types, model.device
        self._u = wp.zeros(model.point_count, dtype=types_.vector, device=device, requires_grad=True)
        self._force = wp.zeros(model.point_count, dtype=types_.vector, device=device, requires_grad=True)
        self._tape: wp.Tape | None = None
        for block in self.averaged:
            block.require_gradients()

    def linearize(self, u, mass_weight, *, hessian="exact", friction=None, precondition=False) -> None:
        if hessian != "exact":
            raise ValueError("a tape differentiates the force as it is: take hessian='exact'")
        super().linearize(u, mass_weight, friction=friction, precondition=precondition)
        wp.copy(self._u, u)
        if self._tape is None:
            with wp.Tape() as self._tape:
                for block in self.model.blocks:
                    if block.kernels.constitutive.differentiable:
                        block.launch("taped_force", [self._u], [self._force])
                    else:
                        backward = functools.partial(self._subtract_closed_form, block)
                        self._tape.record_func(backward, [self._u, self._force])

    def _subtract_closed_form(self, block: CellBlock) -> None:
        product = self.model.zeros()
        block.launch("differential", [self._u, self._force.grad], [product])
        self._launch(self.kernels.subtract, [product], [self._u.grad])

    def _add_stiffness_product(self, p, product_out) -> None:
        for block in self.averaged:
            block.update_pressure(self._u)
        self._tape.backward(grads={self._force: p})
        self._launch(self.kernels.subtract, [self._u.grad], [product_out])
        self._tape.zero()

    def arrays(self) -> list[wp.array]:
        return [*super().arrays(), self._u, self._u.grad, self._force, self._force.grad]


def tangent_operator(model: Model, route: Route, *, external: bool = True) -> TangentOperator:
    """The operator for a route.

    Args:
        model: the model.
        route: "assembled", "closed" or "tape".
        external: whether contact and supports are part of it.
    """
    operators = {"assembled": AssembledOperator, "closed": ClosedFormOperator, "tape": TapeOperator}
    if not isinstance(route, str) or route not in operators:
        raise SimulationError(f"route must be one of {', '.join(map(repr, operators))}, not {route!r}")
    return operators[route](model, external)


def _block_pattern(model: Model) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Compressed rows of all pairs of points that share a cell, and each cell's places in them."""
    n = model.point_count
    pairs = [block.host_cells.astype(np.int64)[:, :, None] * n + block.host_cells[:, None, :] for block in model.blocks]
    keys, places = np.unique(np.concatenate([own.ravel() for own in pairs]), return_inverse=True)
    row_starts = np.searchsorted(keys, np.arange(n + 1, dtype=np.int64) * n)
    ends = np.cumsum([own.size for own in pairs])[:-1]
    slots = [own.reshape(pair.shape) for own, pair in zip(np.split(places, ends), pairs, strict=True)]
    return row_starts, keys % n, slots


class LinearStatus(Enum):
    """How a linear solve ended."""

    CONVERGED = "converged"
    ITERATIONS = "stopped at the iteration limit"
    CURVATURE = "met a direction of negative curvature"


@dataclass(frozen=True)
class LinearResult:
    """Result of a linear solve.

    Attributes:
        iterations: iterations done.
        residual: |r| / |b| by the recursion.
        status: how it ended.
    """

    iterations: int
    residual: float
    status: LinearStatus


class ConjugateGradients:
    """Preconditioned conjugate gradients for the tangent operators of a model (Hestenes and Stiefel 1952).

    Stops early at a direction of negative curvature with what it has, which is a descent direction for
    Newton's method (Nocedal and Wright 2006, algorithm 7.1).
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        kernels = _gradient_kernels(model.dim, model.dtype)
        self._r, self._z, self._p, self._q = (model.zeros() for _ in range(4))
        self._scalars = wp.zeros(4, dtype=wp.float64, device=model.device)
        self._kernels = kernels

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        return [self._r, self._z, self._p, self._q, self._scalars]

    @property
    def direction(self) -> tuple[np.ndarray, np.ndarray]:
        """The last search direction p and its product A p, float64 copies (point_count, dim)."""
        return self._p.numpy().astype(np.float64), self._q.numpy().astype(np.float64)

    def solve(
        self,
        operator: TangentOperator,
        b: wp.array,
        x: wp.array,
        *,
        tolerance: float,
        max_iterations: int,
    ) -> LinearResult:
        """Solves A x = b from x = 0 until |r| <= tolerance |b|; overwrites ``x``.

        Args:
            operator: A, linearised with ``precondition=True``.
            b: right-hand side, zero where held.
            x: the solution.
            tolerance: relative residual to reach.
            max_iterations: limit of iterations.
        """
        model, kernels = self.model, self._kernels
        r, z, p, q, scalars = self._r, self._z, self._p, self._q, self._scalars
        B = operator.inverse_diagonal
        n, parts, device = model.point_count, chunks(model.point_count), model.device

        def record(kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> wp.Launch:
            return wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=device, record_cmd=True)

        prepare = record(kernels.prepare, 1, [], [scalars])
        curvature = record(kernels.curvature, parts, [p, q], [scalars])
        advance = record(kernels.advance, parts, [p, q, B], [x, r, z, scalars])
        turn = record(kernels.turn, n, [z, scalars], [p])

        x.zero_()
        scalars.zero_()
        wp.launch(kernels.start, parts, inputs=[b, B], outputs=[r, p, scalars], device=device)
        start = float(scalars.numpy()[_RESIDUAL]) ** 0.5
        if start == 0.0:
            return LinearResult(0, 0.0, LinearStatus.CONVERGED)
        residual = start
        for iteration in range(max_iterations):
            prepare.launch()
            operator.apply(p, q)
            curvature.launch()
            if not scalars.numpy()[_CURVATURE] > 0.0:
                if iteration == 0:
                    wp.copy(x, p)  # the preconditioned right-hand side still descends
                return LinearResult(iteration, residual / start, LinearStatus.CURVATURE)
            advance.launch()
            residual = float(scalars.numpy()[_RESIDUAL]) ** 0.5
            if residual <= tolerance * start:
                return LinearResult(iteration + 1, residual / start, LinearStatus.CONVERGED)
            turn.launch()
        return LinearResult(max_iterations, residual / start, LinearStatus.ITERATIONS)
