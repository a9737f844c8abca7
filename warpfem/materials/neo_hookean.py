"""The compressible Neo-Hookean material."""

from typing import Any

import warp as wp

from warpfem.materials.base import Constitutive, HookeanMaterial
from warpfem.materials.volumetric import LOG_VOLUME_RATIO
from warpfem.tensor import (
    cofactor,
    deformation_gradient,
    distortion,
    length_change,
    log1p_deficit,
    log_volume_ratio,
    plus_diagonal,
    volume_change,
    volume_ratio,
)


@wp.func
def energy_density(H: Any, parameters: Any):
    half = H.dtype(0.5)
    J = volume_ratio(H)
    if not (H.dtype(0.0) < J):
        return H.dtype(wp.inf)
    log_j = log_volume_ratio(H)
    j = volume_change(H)
    shear = half * length_change(H) - log_j
    if wp.abs(j) < half:  # where these would cancel
        shear = half * distortion(H) + log1p_deficit(j)
    return parameters[0] * shear + half * parameters[1] * log_j * log_j


@wp.func
def stress(H: Any, parameters: Any):
    # P = tau F^-T with the Kirchhoff stress tau = mu (F F^T - I) + lam ln(J) I
    transposed = wp.transpose(H)
    inverse = H.dtype(1.0) / volume_ratio(H)
    strain = (parameters[0] * inverse) * (H + transposed + H * transposed)
    kirchhoff_over_j = plus_diagonal(strain, parameters[1] * inverse * log_volume_ratio(H))
    return kirchhoff_over_j * cofactor(deformation_gradient(H))


@wp.func
def stress_differential(H: Any, dH: Any, parameters: Any):
    # dP = mu dF + (mu - lam ln J) F^-T dF^T F^-T + lam (F^-T : dF) F^-T
    G = (H.dtype(1.0) / volume_ratio(H)) * cofactor(deformation_gradient(H))
    return (
        parameters[0] * dH
        + (parameters[0] - parameters[1] * log_volume_ratio(H)) * (G * wp.transpose(dH) * G)
        + (parameters[1] * wp.ddot(G, dH)) * G
    )


class NeoHookean(HookeanMaterial):
    """Neo-Hookean: psi = mu/2 (I_C - d) - mu ln J + lam/2 (ln J)^2 (Bonet and Wood 2008, eq. 6.27).

    P = mu (F - F^-T) + lam ln(J) F^-T. For J > 0 only: the energy is infinite and the stress is not a
    number for J <= 0. With lam < 0 (nu < 0) the energy has no lower bound.
    """

    name = "neo_hookean"
    least_nu = 0.0
    functions = Constitutive(
        energy_density, stress, stress_differential, barrier=True, branchless=True, volumetric=LOG_VOLUME_RATIO
    )
