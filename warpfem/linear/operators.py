"""Tangent operators A = w M + K(u) + contact, by three routes.

The three routes to the stiffness product K p (Hu 2020, force differentials): ``wp.Tape`` replays the force
kernel backwards, because K is symmetric; the closed form evaluates each material's stress differential; the
assembled route stores K as d x d blocks in compressed rows, whose pattern is found once from the topology.
"""

import functools
from abc import ABC, abstractmethod
from types import SimpleNamespace
from typing import Any, Literal, TypeAlias

import warp as wp

from warpfem.dtypes import types
from warpfem.elements import Filter
from warpfem.errors import SimulationError
from warpfem.launches import Launcher
from warpfem.linear.assembly import Assembly
from warpfem.linear.slices import SlicedMatrix
from warpfem.model import CellBlock, Model, Route
from warpfem.tensor import is_positive_definite

SLICED_POINTS = 1000
"""Points from which on products are computed many rows at a time, which takes a second to compile once."""

Hessian: TypeAlias = Literal["exact", Filter]


@wp.func
def add_row_product(
    row_starts: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.int32),
    blocks: wp.array(dtype=Any),
    p: wp.array(dtype=Any),
    i: int,
    start: Any,
):
    """``start`` plus the product of row i of a block-sparse matrix with p."""
    total = start
    for slot in range(row_starts[i], row_starts[i + 1]):
        total += blocks[slot] * p[columns[slot]]
    return total


@functools.cache
def operator_kernels(dim: int, dtype: str) -> SimpleNamespace:
    """The kernels that put operators together and apply them."""
    t = types(dim, dtype)
    vector, matrix, scalar = t.vector, t.matrix, t.scalar
    double = wp.types.vector(length=dim, dtype=wp.float64)
    module = f"warpfem.operators_{dim}_{dtype}"

    @wp.kernel(module=module, enable_backward=False)
    def invert_diagonal(
        blocks: wp.array(dtype=matrix),
        diagonal: wp.array(dtype=wp.int32),
        coupling: wp.array(dtype=matrix),
        free: wp.array(dtype=vector),
        inverse_out: wp.array(dtype=matrix),
    ):
        """Inverts the diagonal block of each point, or its mean, where it is not positive definite."""
        i = wp.tid()
        block = blocks[diagonal[i]]
        if coupling.shape[0] > 0:
            if free.shape[0] > 0:
                block += wp.cw_mul(wp.outer(free[i], free[i]), coupling[i])
            else:
                block += coupling[i]
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
        product_out[i] = add_row_product(row_starts, columns, blocks, p, i, vector())

    @wp.kernel(module=module, enable_backward=False)
    def subtract_product(
        row_starts: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        blocks: wp.array(dtype=matrix),
        p: wp.array(dtype=vector),
        b: wp.array(dtype=vector),
        difference_out: wp.array(dtype=vector),
    ):
        """Writes b less the product with p, summed in float64: where they nearly cancel, float32 leaves noise."""
        i = wp.tid()
        total = double()
        for k in range(dim):
            total[k] = wp.float64(b[i][k])
        for slot in range(row_starts[i], row_starts[i + 1]):
            block = blocks[slot]
            q = p[columns[slot]]
            for k in range(dim):
                for m in range(dim):
                    total[k] -= wp.float64(block[k, m]) * wp.float64(q[m])
        result = vector()
        for k in range(dim):
            result[k] = scalar(total[k])
        difference_out[i] = result

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
    def subtract_from(a: wp.array(dtype=vector), difference_out: wp.array(dtype=vector)):
        """Subtracts from a."""
        i = wp.tid()
        difference_out[i] = a[i] - difference_out[i]

    @wp.kernel(module=module, enable_backward=False)
    def subtract(a: wp.array(dtype=vector), difference_out: wp.array(dtype=vector)):
        """Subtracts a."""
        i = wp.tid()
        difference_out[i] -= a[i]

    return SimpleNamespace(**{k: v for k, v in locals().items() if isinstance(v, wp.Kernel)})


class TangentOperator(ABC):
    """A = w M + K(u), with the model's contact and supports when ``external``.

    :meth:`linearize` takes u and w; :meth:`apply` then multiplies. Held components are those of the identity,
    so that a right-hand side that is zero there stays zero.

    Attributes:
        inverse_diagonal: inverse of each point's diagonal block: the block Jacobi preconditioner. Valid
            after ``linearize(..., precondition=True)``.
        fixed: whether :meth:`apply` launches the same kernels with the same arrays whatever the tangent.
        divided: whether it divides them among threads, which no graph can hold.
        revision: counts the tangents taken.
        free: 1 for free and 0 for held components of each point, empty without supports.
        contact_blocks: what contact adds to the diagonal block of each point, empty without contact.
    """

    fixed = False
    divided = False

    def __init__(self, model: Model, external: bool) -> None:
        self.model = model
        self.kernels = operator_kernels(model.dim, model.dtype)
        self.hessian: Hessian = "exact"
        self._launcher = Launcher(model.device)
        self.supports = model.supports if external else None
        self.contact = model.contact if external else None
        self.averaged = [block for block in model.blocks if block.averaged]
        self.inverse_diagonal: wp.array | None = None
        self.revision = 0
        n = model.point_count
        self.free = wp.ones(n if self.supports else 0, dtype=model.types.vector, device=model.device)
        if self.supports is not None:
            self.supports.project(self.free)
        self.contact_blocks = self._new_blocks(n if self.contact else 0)
        self._coupling = self._new_blocks(n if self.averaged else 0)

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

    def subtract_product(self, b: wp.array, p: wp.array, difference_out: wp.array) -> None:
        """Overwrites ``difference_out`` with b - A p."""
        self.apply(p, difference_out)
        self._launch(self.kernels.subtract_from, [b], [difference_out])

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        own = [self.free, self.contact_blocks, self._coupling]
        return own if self.inverse_diagonal is None else [*own, self.inverse_diagonal]

    def _kernel(self, name: str) -> str:
        return name if self.hessian == "exact" else f"{self.hessian}_{name}"

    def _new_blocks(self, count: int) -> wp.array:
        return wp.zeros(count, dtype=self.model.types.matrix, device=self.model.device)

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        self._launcher(kernel, self.model.point_count, inputs, outputs)

    def _linearize_couplings(self, u: wp.array, friction: tuple[wp.array, float] | None) -> None:
        """Those of averaged cells, and contact."""
        self.revision += 1
        for block in self.averaged:
            block.linearize(u)
        if self.contact is None:
            return
        self.contact_blocks.zero_()
        self.contact.add_blocks(u, self.contact_blocks)
        if friction is not None:
            self.contact.add_friction_blocks(*friction, u, self.contact_blocks)

    def _assemble(self, assembly: Assembly, u: wp.array, mass_weight: float) -> None:
        assembly.assemble(self._kernel("stiffness"), u, mass_weight, self.contact_blocks)

    def _invert_diagonal(self, assembly: Assembly) -> None:
        if self.inverse_diagonal is None:
            self.inverse_diagonal = self._new_blocks(self.model.point_count)
        if self.averaged:
            self._coupling.zero_()
        for block in self.averaged:
            block.add_coupling_diagonal(self._coupling)
        inputs = [assembly.blocks, assembly.diagonal, self._coupling, self.free]
        self._launch(self.kernels.invert_diagonal, inputs, [self.inverse_diagonal])


class AssembledOperator(TangentOperator):
    """A stored as d x d blocks in compressed rows.

    Attributes:
        assembly: the matrix, but for the couplings of averaged cells.
    """

    fixed = True

    def __init__(self, model: Model, external: bool) -> None:
        super().__init__(model, external)
        self.assembly = Assembly(model, self.free)
        self._sliced = None
        if model.device.is_cpu and model.point_count >= SLICED_POINTS:  # a GPU has lanes of its own
            pattern = self.assembly.pattern
            self._sliced = SlicedMatrix(
                pattern.row_starts, pattern.columns, self.assembly.blocks, model.dtype, model.team
            )
        self.divided = self._sliced is not None and self._sliced.threads > 1

    def linearize(self, u, mass_weight, *, hessian="exact", friction=None, precondition=False) -> None:
        self.hessian = hessian
        self._linearize_couplings(u, friction)
        self._assemble(self.assembly, u, mass_weight)
        if self._sliced is not None:
            self._sliced.fill()
        if precondition:
            self._invert_diagonal(self.assembly)

    def apply(self, p, product_out) -> None:
        if self._sliced is None:
            self._launch(self.kernels.multiply, [*self._matrix(), p], [product_out])
        else:
            self._sliced.multiply(p, product_out)
        for block in self.averaged:
            block.add_coupling(p, product_out)
        if self.averaged and self.supports is not None:
            self.supports.project(product_out)

    def subtract_product(self, b, p, difference_out) -> None:
        if self.averaged:
            super().subtract_product(b, p, difference_out)
            return
        if self._sliced is None:
            self._launch(self.kernels.subtract_product, [*self._matrix(), p, b], [difference_out])
        else:
            self._sliced.subtract_product(b, p, difference_out)

    def _matrix(self) -> list[wp.array]:
        return [self.assembly.row_starts, self.assembly.columns, self.assembly.blocks]

    def arrays(self) -> list[wp.array]:
        sliced = [] if self._sliced is None else self._sliced.arrays()
        return [*super().arrays(), *self.assembly.arrays(), *sliced]


class _UnassembledOperator(TangentOperator):
    """A whose product with K is computed from the elements each time."""

    def __init__(self, model: Model, external: bool) -> None:
        super().__init__(model, external)
        self.u: wp.array | None = None
        self.mass_weight = 0.0

    @abstractmethod
    def _add_stiffness_product(self, p: wp.array, product_out: wp.array) -> None: ...

    @functools.cached_property
    def _diagonal(self) -> Assembly:
        return Assembly(self.model, self.free, diagonal_only=True)

    def linearize(self, u, mass_weight, *, hessian="exact", friction=None, precondition=False) -> None:
        self.u = u
        self.hessian = hessian
        self.mass_weight = mass_weight
        self._linearize_couplings(u, friction)
        if precondition:
            self._assemble(self._diagonal, u, mass_weight)
            self._invert_diagonal(self._diagonal)

    def apply(self, p, product_out) -> None:
        if self.mass_weight > 0.0:
            self._launch(self.kernels.multiply_mass, [self.model.mass, self.mass_weight, p], [product_out])
        else:
            product_out.zero_()
        self._add_stiffness_product(p, product_out)
        if self.contact is not None:
            self._launch(self.kernels.add_block_product, [self.contact_blocks, p], [product_out])
        if self.supports is not None:
            self.supports.project(product_out)

    def arrays(self) -> list[wp.array]:
        return [*super().arrays(), *(self._diagonal.arrays() if "_diagonal" in self.__dict__ else [])]


class ClosedFormOperator(_UnassembledOperator):
    """A with K p from each material's stress differential in closed form."""

    def _add_stiffness_product(self, p, product_out) -> None:
        name = self._kernel("differential")
        for block in self.model.blocks:
            block.launch(name, [self.u, p], [product_out])
        for block in self.averaged:
            block.add_coupling(p, product_out)


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
