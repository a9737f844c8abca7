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
    identity_like,
    rotation_differential,
    symmetric_part,
    volume_change,
)


@functools.cache
def _constitutive() -> Constitutive:
    """The kernel functions, made when first asked for, as the rotation is."""
    rotation = differentiable_rotation()

    @wp.func
    def rotated_strain(H: Any):
        """F - R = R (S + I)^-1 (F^T F - I), the right side free of cancellation near rest."""
        F = deformation_gradient(H)
        R = rotation(F)
        if wp.ddot(H, H) > H.dtype(0.25):
            return F - R
        S = symmetric_part(wp.transpose(R) * F)
        return R * (wp.inverse(S + identity_like(S)) * (H + wp.transpose(H) + wp.transpose(H) * H))

    @wp.func
    def energy_density(H: Any, parameters: Any):
        strain = rotated_strain(H)
        j = volume_change(H)
        return parameters[0] * wp.ddot(strain, strain) + H.dtype(0.5) * parameters[1] * j * j

    @wp.func
    def stress(H: Any, parameters: Any):
        return (H.dtype(2.0) * parameters[0]) * rotated_strain(H) + (parameters[1] * volume_change(H)) * (
            identity_like(H) + cofactor_change(H)
        )

    @wp.func
    def stress_differential(H: Any, dH: Any, parameters: Any):
        F = deformation_gradient(H)
        C = cofactor(F)
        return (
            (H.dtype(2.0) * parameters[0]) * (dH - rotation_differential(F, dH))
            + (parameters[1] * wp.ddot(C, dH)) * C
            + (parameters[1] * volume_change(H)) * cofactor_differential(F, dH)
        )

    return Constitutive(energy_density, stress, stress_differential, corotated=True, volumetric=VOLUME_CHANGE)


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
