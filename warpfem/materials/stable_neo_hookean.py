"""The stable Neo-Hookean material, in its variant with the logarithm."""

from typing import Any

import warp as wp

from warpfem.materials.base import Constitutive, HookeanMaterial
from warpfem.materials.volumetric import VOLUME_CHANGE
from warpfem.moduli import Parameter
from warpfem.tensor import (
    cofactor,
    cofactor_change,
    cofactor_differential,
    deformation_gradient,
    distortion,
    length_change,
    log1p_deficit,
    plus_diagonal,
    volume_change,
)


@wp.func
def energy_density(H: Any, parameters: Any):
    # psi - psi(I), rearranged so that every term is of second order in H
    half = H.dtype(0.5)
    j = volume_change(H)
    shear = H.dtype(0.375) * distortion(H) + half * log1p_deficit(H.dtype(0.25) * length_change(H))
    return parameters[0] * shear + half * parameters[1] * j * j


@wp.func
def stress(H: Any, parameters: Any):
    # mu' (1 - 1/(I_C + 1)) F + lam' (J - a) cof F, with the parts that cancel at rest taken out
    s = length_change(H)
    softening = parameters[0] * (s / (H.dtype(4.0) * (H.dtype(4.0) + s)))
    shear = H.dtype(0.75) * parameters[0]
    pressure = parameters[1] * volume_change(H)
    return plus_diagonal((shear + softening) * H + (pressure - shear) * cofactor_change(H), softening + pressure)


@wp.func
def stress_differential(H: Any, dH: Any, parameters: Any):
    F = deformation_gradient(H)
    C = cofactor(F)
    one = H.dtype(1.0)
    g = one / (H.dtype(4.0) + length_change(H))  # 1 / (I_C + 1)
    pressure = parameters[1] * volume_change(H) - H.dtype(0.75) * parameters[0]  # lam' (J - a)
    return (
        (parameters[0] * (one - g)) * dH
        + (H.dtype(2.0) * parameters[0] * g * g * wp.ddot(F, dH)) * F
        + (parameters[1] * wp.ddot(C, dH)) * C
        + pressure * cofactor_differential(F, dH)
    )


class StableNeoHookean(HookeanMaterial):
    """Stable Neo-Hookean with the log term (Smith, de Goes and Kim 2018, eq. 13), shifted to psi(I) = 0.

    psi = mu'/2 (I_C - 3 - ln(I_C + 1)) + lam'/2 (J - a)^2 with mu' = 4/3 mu, lam' = lam + 5/6 mu and
    a = 1 + 3 mu'/(4 lam'), which give Hooke's law for mu and lam at rest;
    P = mu' (1 - 1/(I_C + 1)) F + lam' (J - a) cof F. Finite for every F, also for inverted cells, whose
    stress turns them back. Below nu = -0.85 a squashed state has less energy than rest.
    """

    name = "stable_neo_hookean"
    least_nu = -0.85
    functions = Constitutive(energy_density, stress, stress_differential, branchless=True, volumetric=VOLUME_CHANGE)

    def parameters(self) -> tuple[Parameter, ...]:
        mu, lam = self.moduli.mu, self.moduli.lam
        return 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu
