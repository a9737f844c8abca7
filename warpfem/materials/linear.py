"""Linear elasticity."""

from typing import Any

import warp as wp

from warpfem.materials.base import Constitutive, HookeanMaterial
from warpfem.materials.volumetric import TRACE
from warpfem.tensor import identity_like, symmetric_part


@wp.func
def energy_density(H: Any, parameters: Any):
    strain = symmetric_part(H)
    trace = wp.trace(H)
    return parameters[0] * wp.ddot(strain, strain) + H.dtype(0.5) * parameters[1] * trace * trace


@wp.func
def stress(H: Any, parameters: Any):
    return parameters[0] * (H + wp.transpose(H)) + (parameters[1] * wp.trace(H)) * identity_like(H)


@wp.func
def stress_differential(H: Any, dH: Any, parameters: Any):
    return stress(dH, parameters)


class LinearElasticity(HookeanMaterial):
    """Linear elasticity: psi = mu |eps|^2 + lam/2 (tr eps)^2 with eps = sym(F) - I (Hu 2020).

    P = 2 mu eps + lam (tr eps) I. Valid for small rotations (below about 5 degrees): a rotated body
    grows, because a rotation is not free of strain here.
    """

    name = "linear"
    functions = Constitutive(
        energy_density,
        stress,
        stress_differential,
        isotropic=False,
        convex=True,
        small_strain=True,
        branchless=True,
        volumetric=TRACE,
    )
