"""Simplex elements, linear and quadratic: the kernels of energy, force, force differential, stiffness and stress.

The displacement gradient is H = sum_k (u_k - u_0) g_k^T, where g_k is the gradient of the k-th shape function;
F = I + H (Hu 2020; Sifakis and Barbic 2012). In a linear cell g_k is constant, row k of B = D_m^-1. In a quadratic one
it is taken at each of the dim + 1 quadrature points, for which rows of B are the gradients of the barycentric
coordinates.

Kernels run over quadrature points, of which a linear cell has one, but for those of stiffness and frequency, which run
over cells. They take the cells' data as ``cells, parameters`` (one entry for each cell) and ``inverse_shape, volume``
(one for each quadrature point) and exist, each in a module of its own, only once something asks for them.
"""

import functools
from typing import Any, Literal, TypeAlias

import warp as wp

from warpfem.dtypes import types
from warpfem.materials.base import Constitutive
from warpfem.shapes import Shape
from warpfem.stiffness import exact_stiffness_kernel, filtered_stiffness_kernel
from warpfem.tensor import (
    cofactor,
    deformation_gradient,
    embed,
    identity_like,
    is_positive_definite,
    signed_svd,
    volume_change,
)

LARGE = 1e30
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
    """The kernels for one material, shape and precision, each made on first use."""

    def __init__(self, constitutive: Constitutive, shape: Shape, dtype: str) -> None:
        self.constitutive = constitutive
        self.shape = shape
        self.dim = dim = shape.dim
        self.types = types(dim, dtype)
        scalar, vector, matrix = self.types.scalar, self.types.vector, self.types.matrix
        self.cell_type = cell_type = wp.types.vector(length=shape.point_count, dtype=wp.int32)
        self.parameter_vector = wp.types.vector(length=constitutive.parameter_count, dtype=scalar)
        others = shape.point_count - 1
        gradients_type = wp.types.matrix(shape=(others, dim), dtype=scalar)

        if shape.order == 1:

            @wp.func
            def shape_gradients(B: matrix, place: int):
                return B

        else:
            near, far = shape.quadrature_places[0][:2].tolist()
            first_corner = wp.types.vector(length=len(shape.edges), dtype=wp.int32)(*shape.edges[:, 0].tolist())
            second_corner = wp.types.vector(length=len(shape.edges), dtype=wp.int32)(*shape.edges[:, 1].tolist())
            corners_type = wp.types.matrix(shape=(dim + 1, dim), dtype=scalar)
            places_type = wp.types.vector(length=dim + 1, dtype=scalar)

            @wp.func
            def shape_gradients(B: matrix, place: int):
                directions = corners_type()  # the gradients of the barycentric coordinates
                for k in range(dim):
                    directions[k + 1] = B[k]
                    directions[0] = directions[0] - B[k]
                weight = places_type(scalar(far))
                weight[place] = scalar(near)
                four = scalar(4.0)
                result = gradients_type()
                for k in range(dim):
                    result[k] = (four * weight[k + 1] - scalar(1.0)) * B[k]
                for k in range(wp.static(len(shape.edges))):
                    a = wp.static(first_corner)[k]
                    b = wp.static(second_corner)[k]
                    result[dim + k] = four * (weight[a] * directions[b] + weight[b] * directions[a])
                return result

        @wp.func
        def displacement_gradient(u: wp.array(dtype=vector), cell: cell_type, gradients: gradients_type):
            origin = u[cell[0]]
            H = wp.outer(u[cell[1]] - origin, gradients[0])
            for k in range(1, others):
                H += wp.outer(u[cell[k + 1]] - origin, gradients[k])
            return H

        @wp.func
        def add_divergence(
            cell: cell_type, gradients: gradients_type, weighted: matrix, force_out: wp.array(dtype=vector)
        ):
            total = vector()
            for k in range(others):
                f = weighted * gradients[k]
                total += f
                wp.atomic_add(force_out, cell[k + 1], f)
            wp.atomic_add(force_out, cell[0], -total)

        self._shape_gradients = shape_gradients
        self._displacement_gradient = displacement_gradient
        self._add_divergence = add_divergence

    @functools.cached_property
    def energy(self) -> wp.Kernel:
        """Adds the volume-weighted energy of each cell to ``energy_out[0]`` (float64)."""
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        shape_gradients, displacement_gradient = self._shape_gradients, self._displacement_gradient
        places = self.shape.quadrature_count
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
            c = i // places
            H = displacement_gradient(u, cells[c], shape_gradients(inverse_shape[i], i % places))
            wp.atomic_add(energy_out, 0, wp.float64(volume[i] * energy_density(H, parameters[c])))

        return element_energy

    @functools.cached_property
    def density(self) -> wp.Kernel:
        """Writes the energy density psi at each quadrature point."""
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        shape_gradients, displacement_gradient = self._shape_gradients, self._displacement_gradient
        places = self.shape.quadrature_count
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
            c = i // places
            H = displacement_gradient(u, cells[c], shape_gradients(inverse_shape[i], i % places))
            density_out[i] = energy_density(H, parameters[c])

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
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        shape_gradients, displacement_gradient = self._shape_gradients, self._displacement_gradient
        add_divergence = self._add_divergence
        places = self.shape.quadrature_count
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
            c = i // places
            cell = cells[c]
            gradients = shape_gradients(inverse_shape[i], i % places)
            H = displacement_gradient(u, cell, gradients)
            add_divergence(cell, gradients, -volume[i] * stress(H, parameters[c]), force_out)

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
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        shape_gradients, displacement_gradient = self._shape_gradients, self._displacement_gradient
        add_divergence = self._add_divergence
        places = self.shape.quadrature_count
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
            c = i // places
            cell = cells[c]
            gradients = shape_gradients(inverse_shape[i], i % places)
            H = displacement_gradient(u, cell, gradients)
            dH = displacement_gradient(p, cell, gradients)
            dP = apply(tangent(H, parameters[c]), dH, parameters[c])
            add_divergence(cell, gradients, volume[i] * dP, product_out)

        return element_differential

    @functools.cached_property
    def stiffness(self) -> wp.Kernel:
        """Writes the d x d blocks K_ab of each cell's tangent stiffness to ``entries_out`` (see stiffness.py)."""
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
        return exact_stiffness_kernel(
            self.shape, self.types, self.parameter_vector, self._kinematics, self.constitutive
        )

    def _filtered_stiffness_kernel(self, kind: Filter) -> wp.Kernel:
        tangent, _apply = self._filtered_rule(kind)
        return filtered_stiffness_kernel(self.shape, self.types, self.parameter_vector, self._kinematics, tangent)

    @property
    def _kinematics(self) -> tuple[wp.Function, wp.Function]:
        return self._shape_gradients, self._displacement_gradient

    @functools.cached_property
    def frequency(self) -> wp.Kernel:
        """Raises ``square_out[0]`` to an estimate of the largest squared frequency of each cell alone [1/s^2].

        It runs over cells. By power iteration, which starts where most cells are stiffest.
        """
        return self._linear_frequency() if self.shape.order == 1 else self._quadratic_frequency()

    def _gradient_products(self) -> wp.Function:
        """The sum of b_a b_a^T over the gradients of all d + 1 shape functions of a linear cell, of which B has d."""
        dim = self.dim
        vector, matrix = self.types.vector, self.types.matrix

        @wp.func
        def gradient_products(B: matrix):
            first = vector()
            Q = matrix()
            for k in range(dim):
                first = first + B[k]
                Q += wp.outer(B[k], B[k])
            return Q + wp.outer(first, first)

        return gradient_products

    def _linear_frequency(self) -> wp.Kernel:
        """On the change of H, with lumped mass G -> (d + 1)/rho dP(G) sum_a b_a b_a^T, from the shortest height."""
        dim = self.dim
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        displacement_gradient = self._displacement_gradient
        stress_differential = self.constitutive.stress_differential
        gradient_products = self._gradient_products()

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
            Q = gradient_products(B)
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
            if not (square < scalar(wp.static(LARGE))):
                square = scalar(wp.static(LARGE))
            wp.atomic_max(square_out, 0, square)

        return element_frequency

    def _quadratic_frequency(self) -> wp.Kernel:
        """On displacements M^-1/2 p of the points: p -> M^-1/2 K M^-1/2 p, from the shape functions' gradients."""
        dim = self.dim
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        shape_gradients, displacement_gradient = self._shape_gradients, self._displacement_gradient
        places, point_count = self.shape.quadrature_count, self.shape.point_count
        corner_share, middle_share = self.shape.mass_shares[[0, -1]].tolist()
        stress_differential = self.constitutive.stress_differential
        displacements = wp.types.matrix(shape=(point_count, dim), dtype=scalar)

        @wp.kernel(module="unique", enable_backward=False)
        def element_frequency(
            cells: wp.array(dtype=cell_type),
            inverse_shape: wp.array(dtype=matrix),
            volume: wp.array(dtype=scalar),
            parameters: wp.array(dtype=parameter_vector),
            density: wp.array(dtype=scalar),
            u: wp.array(dtype=vector),
            square_out: wp.array(dtype=scalar),
        ):
            c = wp.tid()
            count = int(places)
            others = int(point_count - 1)
            mass = scalar(0.0)
            p = displacements()
            for place in range(count):
                i = places * c + place
                mass += density[c] * volume[i]
                gradients = shape_gradients(inverse_shape[i], place)
                F = deformation_gradient(displacement_gradient(u, cells[c], gradients))
                for a in range(others):
                    p[a + 1] += F * gradients[a]
                    p[0] = p[0] - F * gradients[a]
            corner_root = wp.sqrt(scalar(corner_share) * mass)
            middle_root = wp.sqrt(scalar(middle_share) * mass)
            square = scalar(0.0)
            rounds = int(6)
            for _round in range(rounds):
                p = p / wp.sqrt(wp.ddot(p, p))
                for a in range(wp.static(dim + 1)):
                    p[a] = p[a] / corner_root
                for a in range(wp.static(dim + 1), point_count):
                    p[a] = p[a] / middle_root
                force = displacements()
                for place in range(count):
                    i = places * c + place
                    gradients = shape_gradients(inverse_shape[i], place)
                    H = displacement_gradient(u, cells[c], gradients)
                    dH = matrix()
                    for a in range(others):
                        dH += wp.outer(p[a + 1] - p[0], gradients[a])
                    weighted = volume[i] * stress_differential(H, dH, parameters[c])
                    for a in range(others):
                        force[a + 1] += weighted * gradients[a]
                        force[0] = force[0] - weighted * gradients[a]
                for a in range(wp.static(dim + 1)):
                    p[a] = force[a] / corner_root
                for a in range(wp.static(dim + 1), point_count):
                    p[a] = force[a] / middle_root
                square = wp.sqrt(wp.ddot(p, p))
            if not (square < scalar(wp.static(LARGE))):
                square = scalar(wp.static(LARGE))
            wp.atomic_max(square_out, 0, square)

        return element_frequency

    @functools.cached_property
    def frequency_bound(self) -> wp.Kernel:
        """Writes (tr A^8)^(1/8) of each linear cell, of which A (d + 1)/density has the squared frequencies [1/s^2].

        On the change G of H, with lumped mass: A G = dP(G) Q, Q = sum_a b_a b_a^T over the gradients of all d + 1 shape
        functions. It has the eigenvalues of M^-1/2 K M^-1/2 of the cell but for those that are zero, so that the norm
        is at least the largest of them, and at most rank^(1/8) of it. In float64.
        """
        dim = self.dim
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        displacement_gradient = self._displacement_gradient
        stress_differential = self.constitutive.stress_differential
        operator = wp.types.matrix(shape=(dim * dim, dim * dim), dtype=wp.float64)
        gradient_products = self._gradient_products()

        @wp.kernel(module="unique", enable_backward=False)
        def element_frequency_bound(
            cells: wp.array(dtype=cell_type),
            inverse_shape: wp.array(dtype=matrix),
            parameters: wp.array(dtype=parameter_vector),
            u: wp.array(dtype=vector),
            bound_out: wp.array(dtype=wp.float64),
        ):
            i = wp.tid()
            B = inverse_shape[i]
            H = displacement_gradient(u, cells[i], B)
            Q = gradient_products(B)
            A = operator()
            count = int(dim)
            for k in range(count):
                axis = vector()
                axis[k] = scalar(1.0)
                for j in range(count):
                    dP = stress_differential(H, wp.outer(axis, Q[j]), parameters[i])
                    for m in range(dim):
                        for n in range(dim):
                            A[dim * m + n, dim * k + j] = wp.float64(dP[m, n])
            size = wp.sqrt(wp.ddot(A, A))
            if size > wp.float64(0.0):
                A = A / size
            A = A * A
            A = A * A
            bound_out[i] = size * wp.pow(wp.ddot(A, wp.transpose(A)), wp.float64(0.125))

        return element_frequency_bound

    @functools.cached_property
    def step_limit(self) -> wp.Kernel:
        """Lowers ``limit_out[0]`` to the least s > 0 at which u + s p takes a cell to J = 0.

        J is a polynomial in s. With its negative coefficients alone it is a bound from below that falls
        steadily, so that its root is never beyond the first one of J; from there the next bound starts.
        """
        dim = self.dim
        scalar, vector, matrix, cell_type = self._types
        shape_gradients, displacement_gradient = self._shape_gradients, self._displacement_gradient
        places = self.shape.quadrature_count

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
            cell = cells[i // places]
            gradients = shape_gradients(inverse_shape[i], i % places)
            H = displacement_gradient(u, cell, gradients)
            dH = displacement_gradient(p, cell, gradients)
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
        """Writes the 3x3 first Piola-Kirchhoff stress at each quadrature point (plane strain: with the normal one)."""
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        shape_gradients, displacement_gradient = self._shape_gradients, self._displacement_gradient
        places = self.shape.quadrature_count
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
            c = i // places
            H = displacement_gradient(u, cells[c], shape_gradients(inverse_shape[i], i % places))
            stress_out[i] = solid_stress(H, parameters[c])

        return element_stress

    @functools.cached_property
    def diagnostics(self) -> wp.Kernel:
        """Writes J and the von Mises stress sqrt(3/2) |dev tau| / |J| at each quadrature point, |J| at least 1e-6.

        At small strain it is sqrt(3/2) |dev P|.
        """
        scalar, vector, matrix, cell_type = self._types
        parameter_vector = self.parameter_vector
        shape_gradients, displacement_gradient = self._shape_gradients, self._displacement_gradient
        places = self.shape.quadrature_count
        small_strain = self.constitutive.small_strain
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
            c = i // places
            plane = displacement_gradient(u, cells[c], shape_gradients(inverse_shape[i], i % places))
            H = embed(plane)
            J = scalar(1.0) + volume_change(H)
            cauchy = solid_stress(plane, parameters[c])
            if wp.static(not small_strain):
                cauchy = cauchy * wp.transpose(deformation_gradient(H)) / wp.max(wp.abs(J), scalar(1.0e-6))
            deviator = cauchy - (wp.trace(cauchy) / scalar(3.0)) * identity_like(H)
            jacobian_out[i] = J
            von_mises_out[i] = wp.sqrt(scalar(1.5) * wp.ddot(deviator, deviator))

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
        return self.types.scalar, self.types.vector, self.types.matrix, self.cell_type

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
def element_kernels(constitutive: Constitutive, shape: Shape, dtype: str) -> ElementKernels:
    """The kernels of a material for cells of a shape and ``dtype`` "float32" or "float64"; cached."""
    return ElementKernels(constitutive, shape, dtype)
