"""The fixed corotated material."""

import functools
from typing import Any

import warp as wp

from warpfem.materials.base import Constitutive, HookeanMaterial
from warpfem.materials.volumetric import VOLUME_CHANGE
from warpfem.tensor import (
    cofactor,
    cofactor_change,
    cofactor_differential,
    deformation_gradient,
    differentiable_rotation,
    direct_rotation,
    identity_like,
    polar_rotation,
    rotation_change,
    select,
    symmetric_part,
    volume_change,
)


@functools.cache
def _constitutive() -> Constitutive:
    """The kernel functions, made when first asked for, as the rotation is."""
    rotation = differentiable_rotation()

    @wp.func
    def strain(H: Any, R: Any):
        """F - R; near rest as R (S + I)^-1 (F^T F - I), the right side free of cancellation."""
        F = deformation_gradient(H)
        A = symmetric_part(wp.transpose(R) * F) + identity_like(H)
        near = R * (cofactor(A) * (H + wp.transpose(H) + wp.transpose(H) * H)) * (H.dtype(1.0) / wp.determinant(A))
        return select(wp.ddot(H, H) > H.dtype(0.25), F - R, near)

    @wp.func
    def rotated_stress(H: Any, R: Any, parameters: Any):
        return (H.dtype(2.0) * parameters[0]) * strain(H, R) + (parameters[1] * volume_change(H)) * (
            identity_like(H) + cofactor_change(H)
        )

    @wp.func
    def energy_density(H: Any, parameters: Any):
        e = strain(H, rotation(deformation_gradient(H)))
        j = volume_change(H)
        return parameters[0] * wp.ddot(e, e) + H.dtype(0.5) * parameters[1] * j * j

    @wp.func
    def stress(H: Any, parameters: Any):
        return rotated_stress(H, rotation(deformation_gradient(H)), parameters)

    @wp.func
    def direct_stress(H: Any, parameters: Any):
        R, holds = direct_rotation(deformation_gradient(H))
        return rotated_stress(H, R, parameters), holds

    @wp.func
    def rotated_differential(H: Any, R: Any, dH: Any, parameters: Any):
        F = deformation_gradient(H)
        C = cofactor(F)
        return (
            (H.dtype(2.0) * parameters[0]) * (dH - rotation_change(R, F, dH))
            + (parameters[1] * wp.ddot(C, dH)) * C
            + (parameters[1] * volume_change(H)) * cofactor_differential(F, dH)
        )

    @wp.func
    def stress_differential(H: Any, dH: Any, parameters: Any):
        return rotated_differential(H, polar_rotation(deformation_gradient(H)), dH, parameters)

    return Constitutive(
        energy_density,
        stress,
        stress_differential,
        corotated=True,
        rotated_differential=rotated_differential,
        direct_stress=direct_stress,
        volumetric=VOLUME_CHANGE,
    )


class FixedCorotated(HookeanMaterial):
    """Fixed corotated: psi = mu |F - R|^2 + lam/2 (J - 1)^2 (Stomakhin et al. 2012, eq. 5 and 7).

    P = 2 mu (F - R) + lam (J - 1) cof F with F = R S. Finite for every F; R is not unique where two signed
    singular values of F sum to zero. With lam < 0 (nu < 0) the energy has no lower bound. In plane strain R
    is the rotation in the plane, also for a cell that is inverted and stretched above 1 both ways, where the
    rotation closest to diag(F, 1) is another.
    """

    name = "fixed_corotated"
    least_nu = 0.0

    @property
    def constitutive(self) -> Constitutive:
        return _constitutive()
