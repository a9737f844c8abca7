"""The first Piola-Kirchhoff stress P(F) of every material in NumPy, as textbooks write it; F may be complex.

In plane strain F is the 2x2 block, and these are the in-plane parts of P for diag(F, 1).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Stress = Callable[[np.ndarray, float, float], np.ndarray]
"""``stress(F, mu, lam)`` with F (..., d, d) [1], mu and lam Lamé's parameters [Pa]: P (..., d, d) [Pa]."""


def _identity(F: np.ndarray) -> np.ndarray:
    return np.eye(F.shape[-1])


def _transposed(F: np.ndarray) -> np.ndarray:
    return np.swapaxes(F, -1, -2)


def _trace(F: np.ndarray) -> np.ndarray:
    return np.trace(F, axis1=-2, axis2=-1)[..., None, None]


def linear(F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Hooke's law: P = 2 mu eps + lam tr(eps) I, eps = sym F - I."""
    strain = 0.5 * (F + _transposed(F)) - _identity(F)
    return 2.0 * mu * strain + lam * _trace(strain) * _identity(F)


def st_venant_kirchhoff(F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """P = F (2 mu E + lam tr(E) I), E = (F^T F - I)/2."""
    E = 0.5 * (_transposed(F) @ F - _identity(F))
    return F @ (2.0 * mu * E + lam * _trace(E) * _identity(F))


def neo_hookean(F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """P = mu (F - F^-T) + lam ln(J) F^-T (Bonet and Wood 2008, eq. 6.28 times F^-T)."""
    G = _transposed(np.linalg.inv(F))
    return mu * (F - G) + lam * np.log(np.linalg.det(F))[..., None, None] * G


STRESSES: dict[str, Stress] = {
    "linear": linear,
    "st_venant_kirchhoff": st_venant_kirchhoff,
    "neo_hookean": neo_hookean,
}


def tangent(stress: Stress, F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """dP_ij/dF_kl (..., d, d, d, d) by complex steps, exact to rounding (Squire and Trapp 1998)."""
    d = F.shape[-1]
    A = np.empty((*F.shape, d, d))
    for k in range(d):
        for m in range(d):
            step = np.zeros((d, d), dtype=complex)
            step[k, m] = 1e-30j
            A[..., k, m] = stress(F + step, mu, lam).imag * 1e30
    return A


def lame(E: float, nu: float) -> tuple[float, float]:
    """mu, the shear modulus, and lam, Lamé's first parameter."""
    return E / (2.0 * (1.0 + nu)), E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
