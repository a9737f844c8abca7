"""Kernels of averaged cells: the material of a cell under the pressure of its patch, and sums over patches.

The formulas are in averaged.py.
"""

import functools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpfem.dtypes import types
from warpfem.materials.base import Constitutive
from warpfem.materials.volumetric import VolumetricMeasure

# A cell's parameters: mu and the lam that it keeps, as its material takes them, then what its patch averages.
_LAM = wp.constant(2)
_PRESSURE = wp.constant(3)


@functools.cache
def local_constitutive(constitutive: Constitutive) -> Constitutive:
    """The material of a cell with the pressure of its patch as a parameter.

    Its energy density is psi(F; mu, lam_k) alone, since the patch has the rest; its stress holds the pressure.
    """
    material, measure = constitutive, constitutive.volumetric

    @wp.func
    def stress(H: Any, parameters: Any):
        return material.stress(H, parameters) + parameters[_PRESSURE] * measure.gradient(H)

    @wp.func
    def stress_differential(H: Any, dH: Any, parameters: Any):
        own = material.stress_differential(H, dH, parameters)
        return own + parameters[_PRESSURE] * measure.gradient_differential(H, dH)

    # convex materials are those with a linear measure, whose differential is zero
    return replace(
        material,
        stress=stress,
        stress_differential=stress_differential,
        rotated_differential=None,
        parameter_count=4,
        volumetric=None,
    )


@functools.cache
def alone_constitutive(constitutive: Constitutive) -> Constitutive:
    """The material of a cell whose volume change is its own: the averaged stiffness is at most the sum of its.

    The stability limit of explicit steps is estimated with it.
    """
    local, measure = local_constitutive(constitutive), constitutive.volumetric

    @wp.func
    def stress_differential(H: Any, dH: Any, parameters: Any):
        gradient = measure.gradient(H)
        rate = parameters[_LAM] * wp.ddot(gradient, dH)
        return local.stress_differential(H, dH, parameters) + rate * gradient

    return replace(local, stress_differential=stress_differential)


@functools.cache
def patch_kernels(measure: VolumetricMeasure, dim: int, dtype: str) -> SimpleNamespace:
    """The kernels over patches, for a measure of volume change."""
    t = types(dim, dtype)
    scalar, vector, matrix = t.scalar, t.vector, t.matrix
    cell_type = wp.types.vector(length=dim + 1, dtype=wp.int32)
    parameter_vector = wp.types.vector(length=4, dtype=scalar)
    module = f"warpfem.patches_{measure.value.key}_{dim}_{dtype}"  # one, which compiles faster than one for each

    @wp.func
    def displacement_gradient(u: wp.array(dtype=vector), cell: cell_type, B: matrix):
        H = matrix()
        for k in range(dim):
            H += wp.outer(u[cell[k + 1]] - u[cell[0]], B[k])
        return H

    def strain_kernel(enable_backward: bool) -> wp.Kernel:
        @wp.kernel(module="unique" if enable_backward else module, enable_backward=enable_backward)
        def patch_strain(
            cells: wp.array(dtype=cell_type),
            inverse_shape: wp.array(dtype=matrix),
            volume: wp.array(dtype=scalar),
            parameters: wp.array(dtype=parameter_vector),
            starts: wp.array(dtype=wp.int32),
            members: wp.array(dtype=wp.int32),
            inverse_modulus: wp.array(dtype=scalar),
            u: wp.array(dtype=vector),
            strain_out: wp.array(dtype=scalar),
        ):
            """Writes the mean volumetric strain S_g / L_g of each patch."""
            g = wp.tid()
            total = scalar(0.0)
            for k in range(starts[g], starts[g + 1]):
                c = members[k]
                theta = measure.value(displacement_gradient(u, cells[c], inverse_shape[c]))
                total += parameters[c][_LAM] * volume[c] * theta
            strain_out[g] = inverse_modulus[g] * total

        return patch_strain

    def pressure_kernel(enable_backward: bool) -> wp.Kernel:
        @wp.kernel(module="unique" if enable_backward else module, enable_backward=enable_backward)
        def cell_pressure(
            patch: wp.array(dtype=wp.int32),
            strain: wp.array(dtype=scalar),
            parameters_out: wp.array(dtype=parameter_vector),
        ):
            """Writes p_c = lam_c S_g / L_g to the parameters of each cell."""
            i = wp.tid()
            own = parameters_out[i]
            own[_PRESSURE] = own[_LAM] * strain[patch[i]]
            parameters_out[i] = own

        return cell_pressure

    @wp.kernel(module=module, enable_backward=False)
    def patch_energy(
        inverse_modulus: wp.array(dtype=scalar),
        strain: wp.array(dtype=scalar),
        energy_out: wp.array(dtype=wp.float64),
    ):
        """Adds S_g^2 / (2 L_g), infinite where the measure is not a number."""
        g = wp.tid()
        theta = wp.float64(strain[g])
        energy = wp.float64(0.5) * theta * theta / wp.float64(inverse_modulus[g])
        if not wp.isfinite(energy):
            energy = wp.float64(wp.inf)
        wp.atomic_add(energy_out, 0, energy)

    @wp.kernel(module=module, enable_backward=False)
    def cell_density(
        patch: wp.array(dtype=wp.int32),
        parameters: wp.array(dtype=parameter_vector),
        strain: wp.array(dtype=scalar),
        density_out: wp.array(dtype=scalar),
    ):
        """Adds each cell's part lam_c/2 (S_g / L_g)^2 of the patch's energy, per volume."""
        i = wp.tid()
        theta = strain[patch[i]]
        density = scalar(0.5) * parameters[i][_LAM] * theta * theta
        if not wp.isfinite(density):
            density = scalar(wp.inf)
        density_out[i] += density

    @wp.kernel(module=module, enable_backward=False)
    def coupling_rows(
        cells: wp.array(dtype=cell_type),
        inverse_shape: wp.array(dtype=matrix),
        volume: wp.array(dtype=scalar),
        parameters: wp.array(dtype=parameter_vector),
        starts: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        row_starts: wp.array(dtype=wp.int32),
        places: wp.array2d(dtype=wp.int32),
        u: wp.array(dtype=vector),
        rows_out: wp.array(dtype=vector),
    ):
        """Writes r_g = dS_g/du, the entries of the patch's points in rows."""
        g = wp.tid()
        for entry in range(row_starts[g], row_starts[g + 1]):
            rows_out[entry] = vector()
        for k in range(starts[g], starts[g + 1]):
            c = members[k]
            B = inverse_shape[c]
            gradient = (parameters[c][_LAM] * volume[c]) * measure.gradient(displacement_gradient(u, cells[c], B))
            total = vector()
            for corner in range(dim):
                part = gradient * B[corner]
                total += part
                rows_out[places[c, corner + 1]] += part
            rows_out[places[c, 0]] -= total

    @wp.kernel(module=module, enable_backward=False)
    def coupling_rate(
        inverse_modulus: wp.array(dtype=scalar),
        row_starts: wp.array(dtype=wp.int32),
        points: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=vector),
        p: wp.array(dtype=vector),
        rate_out: wp.array(dtype=scalar),
    ):
        """Writes r_g^T p / L_g."""
        g = wp.tid()
        total = scalar(0.0)
        for entry in range(row_starts[g], row_starts[g + 1]):
            total += wp.dot(rows[entry], p[points[entry]])
        rate_out[g] = inverse_modulus[g] * total

    @wp.kernel(module=module, enable_backward=False)
    def coupling_product(
        column_starts: wp.array(dtype=wp.int32),
        column_entries: wp.array(dtype=wp.int32),
        column_patches: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=vector),
        rate: wp.array(dtype=scalar),
        product_out: wp.array(dtype=vector),
    ):
        """Adds r_g r_g^T p / L_g."""
        i = wp.tid()
        total = vector()
        for k in range(column_starts[i], column_starts[i + 1]):
            total += rate[column_patches[k]] * rows[column_entries[k]]
        product_out[i] += total

    @wp.kernel(module=module, enable_backward=False)
    def coupling_diagonal(
        inverse_modulus: wp.array(dtype=scalar),
        column_starts: wp.array(dtype=wp.int32),
        column_entries: wp.array(dtype=wp.int32),
        column_patches: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=vector),
        blocks_out: wp.array(dtype=matrix),
    ):
        """Adds the blocks of r_g r_g^T / L_g on the diagonal."""
        i = wp.tid()
        for k in range(column_starts[i], column_starts[i + 1]):
            row = rows[column_entries[k]]
            blocks_out[i] += wp.outer(inverse_modulus[column_patches[k]] * row, row)

    return SimpleNamespace(
        strain=strain_kernel(False),
        taped_strain=strain_kernel(True),
        pressure=pressure_kernel(False),
        taped_pressure=pressure_kernel(True),
        energy=patch_energy,
        density=cell_density,
        rows=coupling_rows,
        rate=coupling_rate,
        product=coupling_product,
        diagonal=coupling_diagonal,
    )
