"""Linear simplex elements: the kernels of energy, force, force differential, stiffness and stress.

A cell with rest shape matrix D_m has the constant displacement gradient H = sum_k (u_k - u_0) b_k^T, where
b_k is row k of B = D_m^-1, the gradient of the k-th shape function; F = I + H (Hu 2020; Sifakis and Barbic
2012). Kernels take the cells' data as ``cells, inverse_shape, volume, parameters`` and exist, each in a
module of its own, only once something asks for them.
"""

import functools
from typing import Any, Literal, TypeAlias

import warp as wp

from warpfem.dtypes import types
from warpfem.materials.base import Constitutive
from warpfem.tensor import (
    cofactor,
    deformation_gradient,
    embed,
    identity_like,
    is_positive_definite,
    signed_svd,
    volume_change,
)

_LARGE = 1e30
"""What stands for a squared frequency that is not finite [1/s^2]."""

Filter: TypeAlias = Literal["absolute", "clamped"]
"""What becomes of the negative eigenvalues of a cell's d²psi/dF²: their absolute values, or zero."""


@wp.func
def _absolute(eigenvalue: Any):
    return wp.abs(eigenvalue)


@wp.func
def _clamped(eigenvalue: Any):
    return wp.max(eigenvalue, type(eigenvalue)(0.0))


_FILTERS = {"absolute": _absolute, "clamped": _clamped}


class ElementKernels:
    """The kernels for one material, dimension and precision, each made on first use."""

    def __init__(self, constitutive: Constitutive, dim: int, dtype: str) -> None:
        self.constitutive = constitutive
        self.dim = dim
        self.types = types(dim, dtype)
        scalar, vector, matrix, cell_type = (
            self.types.scalar,
            self.types.vector,
            self.types.matrix,
            self.types.cell,
        )
        self.parameter_vector = wp.types.vector(length=constitutive.parameter_count, dtype=scalar)

        @wp.func
        def displacement_gradient(u: wp.array(dtype=vector), cell: cell_type, B: matrix):
            origin = u[cell[0]]
            H = wp.outer(u[cell[1]] - origin, B[0])
            for k in range(1, dim):
                H += wp.outer(u[cell[k + 1]] - origin, B[k])
            return H

        @wp.func
        def add_block(blocks: wp.array(dtype=matrix), slot: int, block: matrix):
            if slot >= 0:
                wp.atomic_add(blocks, slot, block)

        self._displacement_gradient = displacement_gradient
        self._add_block = add_block

    @functools.cached_property
    def energy(self) -> wp.Kernel:
        """Adds the volume-weighted energy of each cell to ``energy_out[0]`` (float64)."""
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        displacement_gradient = self._displacement_gradient
        energy_density = self.constitutive.energy_density

        @wp.kernel(module="unique", enable_backward=False)
        def element_energy(
            cells: wp.array(dtype=cell_type),
            inverse_shape: wp.array(dtype=matrix),
            volume: wp.array(dtype=scalar),
            parameters: wp.array(dtype=parameter_vector),
            u: wp.array(dtype=vector),
            energy_out: wp.array(dtype=wp.float64),
        ):
            i = wp.tid()
            H = displacement_gradient(u, cells[i], inverse_shape[i])
            wp.atomic_add(energy_out, 0, wp.float64(volume[i] * energy_density(H, parameters[i])))

        return element_energy

    @functools.cached_property
    def density(self) -> wp.Kernel:
        """Writes the energy density psi of each cell."""
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        displacement_gradient = self._displacement_gradient
        energy_density = self.constitutive.energy_density

        @wp.kernel(module="unique", enable_backward=False)
        def element_density(
            cells: wp.array(dtype=cell_type),
            inverse_shape: wp.array(dtype=matrix),
            parameters: wp.array(dtype=parameter_vector),
            u: wp.array(dtype=vector),
            density_out: wp.array(dtype=scalar),
        ):
            i = wp.tid()
            H = displacement_gradient(u, cells[i], inverse_shape[i])
            density_out[i] = energy_density(H, parameters[i])

        return element_density

    @functools.cached_property
    def force(self) -> wp.Kernel:
        """Adds the internal forces -dU/du to ``force_out``."""
        return self._force_kernel(enable_backward=False)

    @functools.cached_property
    def taped_force(self) -> wp.Kernel:
        """:attr:`force` with its adjoint, for ``wp.Tape``."""
        if not self.constitutive.differentiable:
            raise TypeError("Warp cannot differentiate the stress of this material")
        return self._force_kernel(enable_backward=True)

    def _force_kernel(self, enable_backward: bool) -> wp.Kernel:
        dim = self.dim
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        displacement_gradient = self._displacement_gradient
        stress = self.constitutive.stress

        @wp.kernel(module="unique", enable_backward=enable_backward)
        def element_force(
            cells: wp.array(dtype=cell_type),
            inverse_shape: wp.array(dtype=matrix),
            volume: wp.array(dtype=scalar),
            parameters: wp.array(dtype=parameter_vector),
            u: wp.array(dtype=vector),
            force_out: wp.array(dtype=vector),
        ):
            i = wp.tid()
            cell = cells[i]
            B = inverse_shape[i]
            H = displacement_gradient(u, cell, B)
            weighted = -volume[i] * stress(H, parameters[i])
            total = vector()
            for k in range(dim):
                f = weighted * B[k]
                total += f
                wp.atomic_add(force_out, cell[k + 1], f)
            wp.atomic_add(force_out, cell[0], -total)

        return element_force

    @functools.cached_property
    def differential(self) -> wp.Kernel:
        """Adds K(u) p to ``product_out``, K = d²U/du² the tangent stiffness, without forming K."""
        return self._differential_kernel(self._exact_rule())

    @functools.cached_property
    def clamped_differential(self) -> wp.Kernel:
        """:attr:`differential` with each element's K made positive semi-definite (isotropic materials)."""
        return self._differential_kernel(self._filtered_rule("clamped")) if self._filterable else self.differential

    @functools.cached_property
    def absolute_differential(self) -> wp.Kernel:
        """:attr:`differential` with the absolute values of each element's eigenvalues (isotropic materials)."""
        return self._differential_kernel(self._filtered_rule("absolute")) if self._filterable else self.differential

    def _differential_kernel(self, rule: tuple) -> wp.Kernel:
        dim = self.dim
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        displacement_gradient = self._displacement_gradient
        tangent, apply = rule

        @wp.kernel(module="unique", enable_backward=False)
        def element_differential(
            cells: wp.array(dtype=cell_type),
            inverse_shape: wp.array(dtype=matrix),
            volume: wp.array(dtype=scalar),
            parameters: wp.array(dtype=parameter_vector),
            u: wp.array(dtype=vector),
            p: wp.array(dtype=vector),
            product_out: wp.array(dtype=vector),
        ):
            i = wp.tid()
            cell = cells[i]
            B = inverse_shape[i]
            H = displacement_gradient(u, cell, B)
            dH = displacement_gradient(p, cell, B)
            weighted = volume[i] * apply(tangent(H, parameters[i]), dH, parameters[i])
            total = vector()
            for k in range(dim):
                f = weighted * B[k]
                total += f
                wp.atomic_add(product_out, cell[k + 1], f)
            wp.atomic_add(product_out, cell[0], -total)

        return element_differential

    @functools.cached_property
    def stiffness(self) -> wp.Kernel:
        """Adds the d x d blocks K_ab of each cell's tangent stiffness to ``blocks_out[slots[i, a, b]]``.

        A block whose slot is negative is left out.
        """
        return self._exact_stiffness_kernel()

    @functools.cached_property
    def clamped_stiffness(self) -> wp.Kernel:
        """:attr:`stiffness` with each element's K made positive semi-definite (isotropic materials)."""
        return self._filtered_stiffness_kernel("clamped") if self._filterable else self.stiffness

    @functools.cached_property
    def absolute_stiffness(self) -> wp.Kernel:
        """:attr:`stiffness` with the absolute values of each element's eigenvalues (isotropic materials)."""
        return self._filtered_stiffness_kernel("absolute") if self._filterable else self.stiffness

    def _exact_stiffness_kernel(self) -> wp.Kernel:
        dim = self.dim
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        add_block = self._add_block
        displacement_gradient = self._displacement_gradient
        stress_differential = self.constitutive.stress_differential

        @wp.kernel(module="unique", enable_backward=False)
        def element_stiffness(
            cells: wp.array(dtype=cell_type),
            inverse_shape: wp.array(dtype=matrix),
            volume: wp.array(dtype=scalar),
            parameters: wp.array(dtype=parameter_vector),
            u: wp.array(dtype=vector),
            slots: wp.array3d(dtype=wp.int32),
            blocks_out: wp.array(dtype=matrix),
        ):
            i = wp.tid()
            B = inverse_shape[i]
            p = parameters[i]
            H = displacement_gradient(u, cells[i], B)
            count = int(dim)
            for b in range(count):  # the columns of shape function b + 1, of component c
                column_sum = matrix()
                for c in range(count):
                    axis = vector()
                    axis[c] = scalar(1.0)
                    dP = volume[i] * stress_differential(H, wp.outer(axis, B[b]), p)
                    for a in range(count):
                        block = wp.outer(dP * B[a], axis)
                        column_sum += block
                        add_block(blocks_out, slots[i, a + 1, b + 1], block)
                        add_block(blocks_out, slots[i, a + 1, 0], -block)
                add_block(blocks_out, slots[i, 0, b + 1], -column_sum)
                add_block(blocks_out, slots[i, 0, 0], column_sum)

        return element_stiffness

    def _filtered_stiffness_kernel(self, kind: Filter) -> wp.Kernel:
        dim = self.dim
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        add_block = self._add_block
        displacement_gradient = self._displacement_gradient
        tangent, _apply = self._filtered_rule(kind)
        gradients_type = wp.types.matrix(shape=(dim + 1, dim), dtype=scalar)

        @wp.kernel(module="unique", enable_backward=False)
        def filtered_element_stiffness(
            cells: wp.array(dtype=cell_type),
            inverse_shape: wp.array(dtype=matrix),
            volume: wp.array(dtype=scalar),
            parameters: wp.array(dtype=parameter_vector),
            u: wp.array(dtype=vector),
            slots: wp.array3d(dtype=wp.int32),
            blocks_out: wp.array(dtype=matrix),
        ):
            i = wp.tid()
            B = inverse_shape[i]
            t = tangent(displacement_gradient(u, cells[i], B), parameters[i])
            gradients = gradients_type()  # of the shape functions, in the principal axes of C
            for k in range(dim):
                g = B[k] * t.V
                gradients[k + 1] = g
                gradients[0] = gradients[0] - g
            corners = int(dim + 1)
            for a in range(corners):
                g = gradients[a]
                for b in range(a, corners):
                    h = gradients[b]
                    # K_ab in the principal axes: entry (m, n) is the sum over j, l of dP_mj/dF_nl g_j h_l
                    K = wp.cw_mul(t.stretch, wp.outer(g, h)) + wp.cw_mul(t.swapped, wp.outer(h, g))
                    K += wp.diag(t.same * wp.cw_mul(g, h))
                    block = volume[i] * (t.U * K * wp.transpose(t.U))
                    add_block(blocks_out, slots[i, a, b], block)
                    if b > a:
                        add_block(blocks_out, slots[i, b, a], wp.transpose(block))

        return filtered_element_stiffness

    @functools.cached_property
    def frequency(self) -> wp.Kernel:
        """Raises ``square_out[0]`` to an estimate of the largest squared frequency of each cell alone [1/s^2].

        By power iteration on the change of H: with lumped mass it is G -> (d + 1)/rho dP(G) sum_a b_a b_a^T. It
        starts along the shortest height of the cell, where most cells are stiffest.
        """
        dim = self.dim
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        displacement_gradient = self._displacement_gradient
        stress_differential = self.constitutive.stress_differential

        @wp.kernel(module="unique", enable_backward=False)
        def element_frequency(
            cells: wp.array(dtype=cell_type),
            inverse_shape: wp.array(dtype=matrix),
            parameters: wp.array(dtype=parameter_vector),
            density: wp.array(dtype=scalar),
            u: wp.array(dtype=vector),
            square_out: wp.array(dtype=scalar),
        ):
            i = wp.tid()
            B = inverse_shape[i]
            H = displacement_gradient(u, cells[i], B)
            first = vector()
            Q = matrix()
            for k in range(dim):
                first = first + B[k]
                Q += wp.outer(B[k], B[k])
            Q += wp.outer(first, first)
            scale = wp.trace(Q)
            Q = Q / scale
            G = Q
            for k in range(dim):
                G[k, (k + 1) % dim] += scalar(0.1)
            G = deformation_gradient(H) * G  # turned with the body
            size = scalar(0.0)
            rounds = int(3)
            for _round in range(rounds):
                G = G / wp.sqrt(wp.ddot(G, G))
                G = stress_differential(H, G, parameters[i]) * Q
                size = wp.sqrt(wp.ddot(G, G))
            square = (scalar(float(dim + 1)) * scale / density[i]) * size
            if not (square < scalar(wp.static(_LARGE))):
                square = scalar(wp.static(_LARGE))
            wp.atomic_max(square_out, 0, square)

        return element_frequency

    @functools.cached_property
    def step_limit(self) -> wp.Kernel:
        """Lowers ``limit_out[0]`` to the least s > 0 at which u + s p takes a cell to J = 0.

        J is a polynomial in s. With its negative coefficients alone it is a bound from below that falls
        steadily, so that its root is never beyond the first one of J; from there the next bound starts.
        """
        dim = self.dim
        scalar, vector, matrix, cell_type = self._types
        displacement_gradient = self._displacement_gradient

        @wp.func
        def cubic_part(dH: matrix):
            if wp.static(dim == 3):
                return wp.determinant(dH)
            return scalar(0.0)

        @wp.func
        def quadratic_part(F: matrix, dH: matrix):
            if wp.static(dim == 3):
                return wp.ddot(F, cofactor(dH))
            return wp.determinant(dH)

        @wp.kernel(module="unique", enable_backward=False)
        def element_step_limit(
            cells: wp.array(dtype=cell_type),
            inverse_shape: wp.array(dtype=matrix),
            u: wp.array(dtype=vector),
            p: wp.array(dtype=vector),
            limit_out: wp.array(dtype=scalar),
        ):
            i = wp.tid()
            zero = scalar(0.0)
            cell = cells[i]
            H = displacement_gradient(u, cell, inverse_shape[i])
            dH = displacement_gradient(p, cell, inverse_shape[i])
            c3 = wp.min(cubic_part(dH), zero)
            s = zero
            searching = bool(True)
            rounds = int(20)
            for _round in range(rounds):
                if searching:
                    now = H + s * dH
                    J = scalar(1.0) + volume_change(now)
                    F = deformation_gradient(now)
                    c1 = wp.min(wp.ddot(cofactor(F), dH), zero)
                    c2 = wp.min(quadratic_part(F, dH), zero)
                    rest = limit_out[0] - s
                    bound = J + rest * (c1 + rest * (c2 + rest * c3))
                    if J > zero and bound > zero:
                        s = limit_out[0]
                    if J <= zero or bound > zero:
                        searching = bool(False)
                    else:
                        step = rest  # Newton's method from the right: the bound is concave
                        for _iteration in range(rounds):
                            value = J + step * (c1 + step * (c2 + step * c3))
                            slope = c1 + step * (scalar(2.0) * c2 + step * scalar(3.0) * c3)
                            step = step - value / slope
                        s += scalar(0.999) * step
                        if step <= scalar(1.0e-3) * s:
                            searching = bool(False)
            wp.atomic_min(limit_out, 0, s)

        return element_step_limit

    @functools.cached_property
    def stress(self) -> wp.Kernel:
        """Writes the 3x3 first Piola-Kirchhoff stress of each cell (plane strain: with the normal stress)."""
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        displacement_gradient = self._displacement_gradient
        solid_stress = self._solid_stress()
        solid = wp.types.matrix(shape=(3, 3), dtype=scalar)

        @wp.kernel(module="unique", enable_backward=False)
        def element_stress(
            cells: wp.array(dtype=cell_type),
            inverse_shape: wp.array(dtype=matrix),
            parameters: wp.array(dtype=parameter_vector),
            u: wp.array(dtype=vector),
            stress_out: wp.array(dtype=solid),
        ):
            i = wp.tid()
            H = displacement_gradient(u, cells[i], inverse_shape[i])
            stress_out[i] = solid_stress(H, parameters[i])

        return element_stress

    @functools.cached_property
    def diagnostics(self) -> wp.Kernel:
        """Writes J and the von Mises stress sqrt(3/2) |dev tau| / |J| of each cell, with |J| at least 1e-6."""
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        displacement_gradient = self._displacement_gradient
        solid_stress = self._solid_stress()

        @wp.kernel(module="unique", enable_backward=False)
        def element_diagnostics(
            cells: wp.array(dtype=cell_type),
            inverse_shape: wp.array(dtype=matrix),
            parameters: wp.array(dtype=parameter_vector),
            u: wp.array(dtype=vector),
            jacobian_out: wp.array(dtype=scalar),
            von_mises_out: wp.array(dtype=scalar),
        ):
            i = wp.tid()
            plane = displacement_gradient(u, cells[i], inverse_shape[i])
            H = embed(plane)
            J = scalar(1.0) + volume_change(H)
            kirchhoff = solid_stress(plane, parameters[i]) * wp.transpose(deformation_gradient(H))
            deviator = kirchhoff - (wp.trace(kirchhoff) / scalar(3.0)) * identity_like(H)
            jacobian_out[i] = J
            von_mises_out[i] = wp.sqrt(scalar(1.5) * wp.ddot(deviator, deviator)) / wp.max(wp.abs(J), scalar(1.0e-6))

        return element_diagnostics

    def _solid_stress(self) -> wp.Function:
        """The 3x3 P; in plane strain its in-plane part is that of the forces, whatever the rotation in space."""
        stress = self.constitutive.stress
        if self.dim == 3:
            return stress

        @wp.func
        def plane_strain_stress(H: Any, parameters: Any):
            _late = wp.grad(wp.neg)(H[0, 0])  # as in _filtered_rule, for a stress that calls wp.grad
            P = stress(embed(H), parameters)
            plane = stress(H, parameters)
            for i in range(2):
                for j in range(2):
                    P[i, j] = plane[i, j]
            return P

        return plane_strain_stress

    @property
    def _filterable(self) -> bool:
        return self.constitutive.isotropic and not self.constitutive.convex

    @property
    def _types(self) -> tuple:
        return self.types.scalar, self.types.vector, self.types.matrix, self.types.cell

    # A rule is a pair of functions: tangent(H, parameters) does what depends on the state alone,
    # apply(tangent, dH, parameters) gives dP.

    def _exact_rule(self) -> tuple:
        @wp.func
        def tangent(H: Any, parameters: Any):
            return H

        return tangent, self.constitutive.stress_differential

    def _filtered_rule(self, kind: Filter) -> tuple:
        """d²psi/dF² of an isotropic material with its negative eigenvalues made positive or zero.

        In the principal axes, F = U diag(s) V^T, the fourth-order tensor falls into one d x d block that
        couples the stretches, and for each pair (i, j) the 2x2 block [[a, b], [b, a]] of the entries ij and
        ji with eigenvalues a + b (flip) and a - b (twist) (Smith, de Goes and Kim 2019). Its entries come
        from the material's own differential at diag(s), so that no material has to state its eigenvalues.
        """
        dim = self.dim
        vector, matrix, scalar = self.types.vector, self.types.matrix, self.types.scalar
        stress_differential = self.constitutive.stress_differential
        corotated = self.constitutive.corotated
        filtered = _FILTERS[kind]

        @wp.func
        def filtered_block(A: matrix):
            if is_positive_definite(A):
                return A
            shift = wp.sqrt(wp.ddot(A, A))
            axes, _s, _axes = signed_svd(A + shift * identity_like(A))  # positive semi-definite: eigenvectors
            D = wp.transpose(axes) * A * axes
            eigenvalues = vector()
            for k in range(dim):
                eigenvalues[k] = filtered(D[k, k])
            return axes * wp.diag(eigenvalues) * wp.transpose(axes)

        @wp.struct
        class Tangent:
            U: matrix
            V: matrix
            stretch: matrix
            same: matrix
            swapped: matrix

        @wp.func
        def tangent(H: matrix, parameters: Any):
            U, s, V = signed_svd(deformation_gradient(H))
            principal = wp.diag(s) - identity_like(H)
            # Warp emits a function that calls wp.grad, as stress_differential may, after those that do not
            _late = wp.grad(wp.neg)(s[0])
            stretch = matrix()
            same = matrix()
            swapped = matrix()
            count = int(dim)
            for i in range(count):
                for j in range(i, count):
                    dH = matrix()
                    dH[i, j] = scalar(1.0)
                    dP = stress_differential(principal, dH, parameters)
                    if i == j:
                        for k in range(count):
                            stretch[k, i] = dP[k, k]
                    else:
                        flip = filtered(dP[i, j] + dP[j, i])
                        twist = dP[i, j] - dP[j, i]
                        if wp.static(corotated) and s[i] + s[j] < scalar(1.0):
                            twist = wp.max(twist, scalar(0.0))  # it has no bound where s_i + s_j nears 0
                        twist = filtered(twist)
                        same[i, j] = scalar(0.5) * (flip + twist)
                        same[j, i] = same[i, j]
                        swapped[i, j] = scalar(0.5) * (flip - twist)
                        swapped[j, i] = swapped[i, j]
            result = Tangent()
            result.U = U
            result.V = V
            result.stretch = filtered_block(scalar(0.5) * (stretch + wp.transpose(stretch)))
            result.same = same
            result.swapped = swapped
            return result

        @wp.func
        def apply(t: Tangent, dH: matrix, parameters: Any):
            G = wp.transpose(t.U) * dH * t.V
            dP = wp.diag(t.stretch * wp.get_diag(G))
            dP += wp.cw_mul(t.same, G) + wp.cw_mul(t.swapped, wp.transpose(G))
            return t.U * dP * wp.transpose(t.V)

        return tangent, apply


@functools.cache
def element_kernels(constitutive: Constitutive, dim: int, dtype: str) -> ElementKernels:
    """The kernels of a material for ``dim`` 2 or 3 and ``dtype`` "float32" or "float64"; cached."""
    return ElementKernels(constitutive, dim, dtype)
