"""A material given by its energy density alone."""

import functools
import inspect
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp

from warpfem.errors import MaterialError
from warpfem.materials.base import Constitutive, Material
from warpfem.moduli import Parameter
from warpfem.tensor import deformation_gradient, embed, in_plane

DIFFERENCE_STEP = 6.0e-6
"""Relative step of the central difference that gives the stress differential: cbrt of float64's epsilon."""


@wp.func
def _cast(A: wp.mat33d, like: wp.float64):
    return A


@wp.func
def _cast(A: wp.mat33d, like: wp.float32):
    return wp.matrix_from_rows(
        wp.vector(wp.float32(A[0, 0]), wp.float32(A[0, 1]), wp.float32(A[0, 2])),
        wp.vector(wp.float32(A[1, 0]), wp.float32(A[1, 1]), wp.float32(A[1, 2])),
        wp.vector(wp.float32(A[2, 0]), wp.float32(A[2, 1]), wp.float32(A[2, 2])),
    )


@wp.func
def _solid_matrix(A: Any):
    """The 3x3 float64 matrix of a 2x2 (plane strain) or 3x3 matrix of either precision."""
    B = embed(A)
    return wp.matrix_from_rows(
        wp.vector(wp.float64(B[0, 0]), wp.float64(B[0, 1]), wp.float64(B[0, 2])),
        wp.vector(wp.float64(B[1, 0]), wp.float64(B[1, 1]), wp.float64(B[1, 2])),
        wp.vector(wp.float64(B[2, 0]), wp.float64(B[2, 1]), wp.float64(B[2, 2])),
    )


@wp.func
def _probe(H: Any, dH: Any):
    """F, half the interval of a central difference along dH, and what turns the difference into a rate."""
    F = deformation_gradient(_solid_matrix(H))
    direction = _solid_matrix(dH)
    one = wp.float64(1.0)
    step = wp.float64(DIFFERENCE_STEP) * wp.max(one, wp.sqrt(wp.ddot(F, F)))
    size = wp.sqrt(wp.ddot(direction, direction))
    if size > wp.float64(0.0):
        step = step / size
    return F, step * direction, one / (wp.float64(2.0) * step)


@functools.cache
def _check(psi: Any, parameter_count: int) -> None:
    """Raises MaterialError unless Warp can compile psi as it is called here (0.1 s the first time)."""
    vector64 = wp.types.vector(length=parameter_count, dtype=wp.float64)

    @wp.kernel(module="unique", enable_backward=False)
    def probe(
        F: wp.array(dtype=wp.mat33d),
        parameters: wp.array(dtype=vector64),
        psi_out: wp.array(dtype=wp.float64),
    ):
        psi_out[0] = psi(F[0], parameters[0])

    try:
        wp.load_module(probe.module, device="cpu")
    except Exception as error:  # Warp raises many types for what it cannot translate
        detail = str(error).partition("\n;")[2] or str(error)  # without the lines about the probe
        raise MaterialError(
            f"EnergyMaterial: psi '{psi.key}' must be psi(F: wp.mat33d, parameters: Any) -> wp.float64, with all "
            f"numbers in float64, as wp.float64(0.5), and {parameter_count} parameters. Warp says: {detail}"
        ) from error


@functools.cache
def _constitutive(psi: Any, parameter_count: int, isotropic: bool) -> Constitutive:
    """The kernel functions of psi: psi and P in float64 whatever the state's precision."""
    name = psi.key.replace(".", "_").replace("<", "").replace(">", "")
    count = wp.constant(parameter_count)
    vector64 = wp.types.vector(length=parameter_count, dtype=wp.float64)

    @wp.func(name=f"{name}_parameters")
    def to_double(parameters: Any):
        result = vector64()
        for i in range(count):
            result[i] = wp.float64(parameters[i])
        return result

    @wp.func(name=f"{name}_energy_density")
    def energy_density(H: Any, parameters: Any):
        return H.dtype(psi(deformation_gradient(_solid_matrix(H)), to_double(parameters)))

    for matrix in (wp.mat22f, wp.mat22d, wp.mat33f, wp.mat33d):
        scalar = matrix._wp_scalar_type_
        vector = wp.types.vector(length=parameter_count, dtype=scalar)

        @wp.func(name=f"{name}_stress")
        def stress(H: matrix, parameters: vector):
            P, _gradient = wp.grad(psi)(deformation_gradient(_solid_matrix(H)), to_double(parameters))
            return in_plane(_cast(P, H[0, 0]), H)

        @wp.func(name=f"{name}_stress_differential")
        def stress_differential(H: matrix, dH: matrix, parameters: vector):
            F, offset, inverse_length = _probe(H, dH)
            p = to_double(parameters)
            ahead, _ahead = wp.grad(psi)(F + offset, p)
            behind, _behind = wp.grad(psi)(F - offset, p)
            return in_plane(_cast((ahead - behind) * inverse_length, H[0, 0]), H)

    return Constitutive(
        energy_density, stress, stress_differential, parameter_count, isotropic=isotropic, differentiable=False
    )


@dataclass(frozen=True, eq=False)
class EnergyMaterial(Material):
    """A hyperelastic material given by its energy density psi(F) alone.

    The stress is the exact derivative of psi by Warp; the stress differential is its central difference, by
    every route, with a relative error of about 1e-9. Both are evaluated in float64 whatever the precision of
    the state, so psi need not be written with care for cancellation near rest.

    Attributes:
        psi: a ``@wp.func`` ``psi(F: wp.mat33d, parameters: Any)`` that returns the energy density [J/m^3] as
            ``wp.float64``. F is always the 3x3 deformation gradient: in plane strain diag(F, 1).
            psi(I) should be 0 and a minimum.
        values: the parameters by name, each a scalar or an array (cell_count,); psi finds them in
            ``parameters`` in this order.
        isotropic: whether psi depends on the principal stretches alone. False keeps Newton's method from
            using the principal axes, which a fibre-reinforced material does not share.

    Raises:
        MaterialError: if psi is not a ``@wp.func`` of two arguments, Warp cannot translate it in float64, or
            there is no parameter or one that is not finite.
    """

    psi: Any
    values: Mapping[str, Parameter]
    isotropic: bool = True

    name: ClassVar[str] = "custom"

    def __post_init__(self) -> None:
        if not isinstance(self.psi, wp.Function):
            raise MaterialError(
                "EnergyMaterial: psi must be decorated with @wp.func, as psi(F: wp.mat33d, parameters: Any)"
            )
        if len(inspect.signature(self.psi.func).parameters) != 2:
            raise MaterialError(f"EnergyMaterial: psi '{self.psi.key}' must take two arguments, F and parameters")
        if not self.values:
            raise MaterialError("EnergyMaterial: give at least one parameter, as values={'mu': 1e5}")
        values = {}
        for name, value in self.values.items():
            try:
                values[name] = np.array(value, dtype=np.float64)
                finite = bool(np.isfinite(values[name]).all())
            except (TypeError, ValueError, OverflowError):
                finite = False
            if not finite:
                raise MaterialError(f"EnergyMaterial: parameter '{name}' must be finite numbers, not {value!r}")
        object.__setattr__(self, "values", values)
        _check(self.psi, len(self.values))

    @property
    def constitutive(self) -> Constitutive:
        return _constitutive(self.psi, len(self.values), self.isotropic)

    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(self.values.values())

    def _with_parameters(self, values: list[Parameter]) -> "EnergyMaterial":
        return replace(self, values=dict(zip(self.values, values, strict=True)))
