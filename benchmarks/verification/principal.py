"""Closed forms of homogeneous deformations, in principal stretches and in simple shear, for each material.

All derive from psi(s1, s2, s3) by hand: P_i = d psi / d s_i. For the two corotated forms of simple shear, F = I + gamma
e1 e2^T has the rotation by the angle atan(gamma/2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ClosedForm:
    """A material's homogeneous responses [Pa].

    Attributes:
        principal: ``principal(s, mu, lam)``: the nominal stress P_1 along axis 1, from the stretches s = (s1, s2, s3).
        shear: ``shear(gamma, mu, lam)``: the in-plane block of P (2, 2) at F = I + gamma e1 e2^T.
    """

    principal: Callable[[tuple[float, float, float], float, float], float]
    shear: Callable[[float, float, float], np.ndarray]


def _linear() -> ClosedForm:
    def principal(s, mu, lam):
        return 2.0 * mu * (s[0] - 1.0) + lam * (sum(s) - 3.0)

    return ClosedForm(principal, lambda g, mu, lam: np.array([[0.0, mu * g], [mu * g, 0.0]]))


def _st_venant_kirchhoff() -> ClosedForm:
    def principal(s, mu, lam):
        return s[0] * (mu * (s[0] ** 2 - 1.0) + 0.5 * lam * (s[0] ** 2 + s[1] ** 2 + s[2] ** 2 - 3.0))

    def shear(g, mu, lam):  # E = [[0, g/2], [g/2, g^2/2]]
        p = 0.5 * lam * g**2
        return np.array([[p + mu * g**2, mu * g + (mu * g**2 + p) * g], [mu * g, mu * g**2 + p]])

    return ClosedForm(principal, shear)


def _neo_hookean() -> ClosedForm:
    def principal(s, mu, lam):
        return mu * (s[0] - 1.0 / s[0]) + lam * np.log(s[0] * s[1] * s[2]) / s[0]

    return ClosedForm(principal, lambda g, mu, lam: np.array([[0.0, mu * g], [mu * g, 0.0]]))  # J = 1


def _fixed_corotated() -> ClosedForm:
    def principal(s, mu, lam):
        return 2.0 * mu * (s[0] - 1.0) + lam * (s[0] * s[1] * s[2] - 1.0) * s[1] * s[2]

    def shear(g, mu, lam):
        c, t = 2.0 / np.hypot(2.0, g), g / np.hypot(2.0, g)  # cos and sin of the angle: R = [[c, t], [-t, c]]
        return 2.0 * mu * np.array([[1.0 - c, g - t], [t, 1.0 - c]])

    return ClosedForm(principal, shear)


def _stable_neo_hookean() -> ClosedForm:
    def constants(mu, lam):
        return 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu

    def principal(s, mu, lam):
        m, k = constants(mu, lam)
        others = s[1] * s[2]
        length = s[0] ** 2 + s[1] ** 2 + s[2] ** 2
        return m * (1.0 - 1.0 / (length + 1.0)) * s[0] + (k * (s[0] * others - 1.0) - 0.75 * m) * others

    def shear(g, mu, lam):  # J = 1, I_C = 3 + g^2, cof F = [[1, 0], [-g, 1]]
        m, _ = constants(mu, lam)
        slope = m * (1.0 - 1.0 / (4.0 + g**2))
        return slope * np.array([[1.0, g], [0.0, 1.0]]) - 0.75 * m * np.array([[1.0, 0.0], [-g, 1.0]])

    return ClosedForm(principal, shear)


CLOSED_FORMS = {
    "linear": _linear(),
    "st_venant_kirchhoff": _st_venant_kirchhoff(),
    "neo_hookean": _neo_hookean(),
    "fixed_corotated": _fixed_corotated(),
    "stable_neo_hookean": _stable_neo_hookean(),
}
"""By the name of the material in ``warpfem.materials.MATERIALS``."""

MODES = ("uniaxial", "equibiaxial", "planar")
"""Which stretches are given: s1, with s2 = s3 free; s1 = s2, with s3 free; s1, with s2 free and s3 = 1."""


def stretches(mode: str, given: float, free: float) -> tuple[float, float, float]:
    """The principal stretches of a mode."""
    if mode == "uniaxial":
        return given, free, free
    return (given, given, free) if mode == "equibiaxial" else (given, free, 1.0)


def free_stretch(name: str, mode: str, given: float, mu: float, lam: float) -> float | None:
    """The free stretch > 0 with no stress along its axis, by bisection; None if there is none that is stable.

    Of several, the one that follows from rest as ``given`` grows or falls. Two free stretches are equal; that is not
    stable where energy falls if one grows and the other shrinks, as in a fixed corotated bar stretched tenfold.
    """
    form = CLOSED_FORMS[name]
    axis = {"uniaxial": 1, "equibiaxial": 2, "planar": 1}[mode]

    def residual(s_given: float, s_free: float) -> float:
        s = stretches(mode, s_given, s_free)
        return float(form.principal((s[axis], *(s[:axis] + s[axis + 1 :])), mu, lam))

    root = 1.0
    for at in np.geomspace(1.0, given, 200):  # follow the branch: widen a bracket about the last root
        low, high = root, root
        for _ in range(200):
            if residual(at, low) <= 0.0 <= residual(at, high):
                break
            low, high = max(0.99 * low, 1e-12), 1.01 * high
        else:
            return None
        for _ in range(80):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if residual(at, middle) < 0.0 else (low, middle)
        root = 0.5 * (low + high)
    if mode == "uniaxial":
        wide, narrow = 1.00001 * root, 0.99999 * root
        if form.principal((wide, given, narrow), mu, lam) <= form.principal((narrow, given, wide), mu, lam):
            return None
    return root
