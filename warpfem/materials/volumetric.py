"""Measures theta of volume change: the material's energy is psi(F; mu, 0) + lam/2 theta(F)^2."""

from dataclasses import dataclass
from typing import Any

import warp as wp

from warpfem.tensor import (
    cofactor,
    cofactor_change,
    cofactor_differential,
    deformation_gradient,
    identity_like,
    log_volume_ratio,
    volume_change,
    volume_ratio,
)


@dataclass(frozen=True, eq=False)
class VolumetricMeasure:
    """What the first Lamé parameter of a material resists, as ``@wp.func`` of H = F - I.

    Attributes:
        value: ``(H) -> theta``, 0 at rest.
        gradient: ``(H) -> dtheta/dF``, the identity at rest.
        gradient_differential: ``(H, dH)`` -> the change of the gradient with H, a symmetric map.
    """

    value: Any
    gradient: Any
    gradient_differential: Any


@wp.func
def trace(H: Any):
    return wp.trace(H)


@wp.func
def trace_gradient(H: Any):
    return identity_like(H)


@wp.func
def trace_gradient_differential(H: Any, dH: Any):
    return H.dtype(0.0) * dH


@wp.func
def green_trace(H: Any):
    return wp.trace(H) + H.dtype(0.5) * wp.ddot(H, H)


@wp.func
def green_trace_gradient(H: Any):
    return deformation_gradient(H)


@wp.func
def green_trace_gradient_differential(H: Any, dH: Any):
    return dH


@wp.func
def volume_change_gradient(H: Any):
    return identity_like(H) + cofactor_change(H)


@wp.func
def volume_change_gradient_differential(H: Any, dH: Any):
    return cofactor_differential(deformation_gradient(H), dH)


@wp.func
def log_gradient(H: Any):
    return cofactor(deformation_gradient(H)) / volume_ratio(H)


@wp.func
def log_gradient_differential(H: Any, dH: Any):
    G = log_gradient(H)
    return -(G * wp.transpose(dH) * G)


TRACE = VolumetricMeasure(trace, trace_gradient, trace_gradient_differential)
"""tr eps = tr H."""

GREEN_TRACE = VolumetricMeasure(green_trace, green_trace_gradient, green_trace_gradient_differential)
"""tr E of the Green strain E = (F^T F - I)/2."""

VOLUME_CHANGE = VolumetricMeasure(volume_change, volume_change_gradient, volume_change_gradient_differential)
"""J - 1."""

LOG_VOLUME_RATIO = VolumetricMeasure(log_volume_ratio, log_gradient, log_gradient_differential)
"""ln J, for J > 0."""
