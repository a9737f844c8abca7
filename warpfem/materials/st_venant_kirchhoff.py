"""The St. Venant-Kirchhoff material."""

from typing import Any

import warp as wp

from warpfem.materials.base import Constitutive, HookeanMaterial
from warpfem.materials.volumetric import GREEN_TRACE
from warpfem.tensor import deformation_gradient, identity_like, symmetric_part


@wp.func
def green_strain(H: Any):
    """E = (F^T F - I) / 2 = (H + H^T + H^T H) / 2."""
    return H.dtype(0.5) * (H + wp.transpose(H) + wp.transpose(H) * H)


@wp.func
def energy_density(H: Any, parameters: Any):
    strain = green_strain(H)
    trace = wp.trace(strain)
    return parameters[0] * wp.ddot(strain, strain) + H.dtype(0.5) * parameters[1] * trace * trace


@wp.func
def second_piola(strain: Any, parameters: Any):
    """S = 2 mu E + lam (tr E) I, linear in E."""
    return (strain.dtype(2.0) * parameters[0]) * strain + (parameters[1] * wp.trace(strain)) * identity_like(strain)


@wp.func
def stress(H: Any, parameters: Any):
    return deformation_gradient(H) * second_piola(green_strain(H), parameters)


@wp.func
def stress_differential(H: Any, dH: Any, parameters: Any):
    # dP = dF S + F dS
    F = deformation_gradient(H)
    change = symmetric_part(wp.transpose(F) * dH)
    return dH * second_piola(green_strain(H), parameters) + F * second_piola(change, parameters)


class StVenantKirchhoff(HookeanMaterial):
    """St. Venant-Kirchhoff: psi = mu |E|^2 + lam/2 (tr E)^2 with E = (F^T F - I)/2 (Sifakis and Barbic 2012).

    P = F (2 mu E + lam (tr E) I). For large rotations and moderate strains: it softens under uniaxial
    compression below a stretch of 1/sqrt(3), and nothing keeps a cell from inverting, or turns it back: a mirrored
    cell has no energy.
    """

    name = "st_venant_kirchhoff"
    resists_mirroring = False
    functions = Constitutive(energy_density, stress, stress_differential, branchless=True, volumetric=GREEN_TRACE)
