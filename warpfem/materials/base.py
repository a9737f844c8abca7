"""What a material is: an energy density psi(F), its stress P = dpsi/dF and its parameters."""

import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from warpfem.errors import MaterialError
from warpfem.materials.volumetric import VolumetricMeasure
from warpfem.moduli import ElasticModuli, Parameter, elastic_moduli


@dataclass(frozen=True, eq=False)
class Constitutive:
    """The kernel functions of a material. Two materials with the same object share their kernels.

    All are ``@wp.func`` of the displacement gradient H = F - I, a 2x2 (plane strain) or 3x3 matrix of
    either precision, and the vector of the cell's parameters.

    Attributes:
        energy_density: ``(H, parameters) -> psi`` [J/m^3]; infinite where the material is not defined.
        stress: ``(H, parameters) -> P``, the first Piola-Kirchhoff stress [Pa].
        stress_differential: ``(H, dH, parameters) -> dP``, the change of P with H, a symmetric map.
        parameter_count: length of the vector of parameters.
        isotropic: whether psi depends on the principal stretches of F alone.
        convex: whether d²psi/dF² is positive semi-definite for every F.
        small_strain: whether the theory is that of small strain, which knows one stress and one shape: P is sigma.
        corotated: whether P holds the rotation of F, whose derivative has no bound where the sum of two singular
            values nears 0.
        barrier: whether psi is infinite for J <= 0, so that a step may not lead there.
        differentiable: whether Warp can differentiate ``stress``: not if it calls ``wp.grad``, through which
            gradients silently do not flow.
        branchless: whether ``stress`` and ``stress_differential`` have neither branches nor calls of library
            functions, so that the compiler can work on several cells at once.
        rotated_differential: ``(H, R, dH, parameters) -> dP``, ``stress_differential`` with the rotation R of F at
            hand, which is then computed once for many dH; it has no branches. ``None`` where P holds no rotation.
        direct_stress: ``(H, parameters) -> (P, holds)``, a form without branches of a ``stress`` that has some;
            ``holds`` is 1 where P is the stress, 0 where only ``stress`` knows it. ``None`` if there is no such form.
        volumetric: the measure theta if the energy is psi(F; mu, 0) + lam/2 theta^2, which averaged cells need; else
            ``None``.
    """

    energy_density: Any
    stress: Any
    stress_differential: Any
    parameter_count: int = 2
    isotropic: bool = True
    convex: bool = False
    small_strain: bool = False
    corotated: bool = False
    barrier: bool = False
    differentiable: bool = True
    branchless: bool = False
    rotated_differential: Any = None
    direct_stress: Any = None
    volumetric: VolumetricMeasure | None = None


class Material(ABC):
    """Base of all materials: the functions and the parameters of a hyperelastic solid."""

    name: ClassVar[str]
    resists_mirroring: ClassVar[bool] = True
    """Whether a mirrored cell has more energy than one at rest."""

    @property
    @abstractmethod
    def constitutive(self) -> Constitutive:
        """The kernel functions."""

    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters that the functions take, each a scalar or an array (cell_count,)."""

    def parameter_rows(self, cell_count: int) -> np.ndarray:
        """The parameters as float64 rows: shape (1, k) if uniform, else (cell_count, k).

        Raises:
            MaterialError: if a parameter is an array of another length.
        """
        columns = [np.asarray(value, dtype=np.float64) for value in self.parameters()]
        for column in columns:
            if column.ndim > 1 or (column.ndim == 1 and len(column) != cell_count):
                raise MaterialError(
                    f"{type(self).__name__}: parameters per cell have shape {column.shape}, "
                    f"but the mesh has {cell_count} cells"
                )
        rows = np.stack(np.broadcast_arrays(*columns), axis=-1)
        return np.atleast_2d(rows)

    def repeated(self, count: int) -> "Material":
        """The material of a mesh whose cells have been divided into ``count`` each, those of a cell together."""
        if all(np.ndim(value) == 0 for value in self.parameters()):
            return self
        return self._with_parameters(
            [np.repeat(value, count) if np.ndim(value) else value for value in self.parameters()]
        )

    def _with_parameters(self, values: list[Parameter]) -> "Material":
        raise MaterialError(f"{type(self).__name__} does not say how to give it other parameters per cell")


@dataclass(frozen=True, eq=False)
class HookeanMaterial(Material):
    """A material that obeys Hooke's law at rest, given by any two of its moduli.

    Attributes:
        E: Young's modulus [Pa].
        nu: Poisson's ratio, in (-1, 0.5).
        K: bulk modulus [Pa].
        lam: Lamé's first parameter [Pa].
        mu: shear modulus [Pa].
        moduli: all of them.

    Each is a scalar or an array (cell_count,). After construction every one of them is set.

    Raises:
        MaterialError: unless exactly two moduli are given and they describe a stable solid.
    """

    E: Parameter | None = None
    nu: Parameter | None = None
    K: Parameter | None = field(default=None, kw_only=True)
    lam: Parameter | None = field(default=None, kw_only=True)
    mu: Parameter | None = field(default=None, kw_only=True)
    moduli: ElasticModuli = field(init=False, repr=False)

    functions: ClassVar[Constitutive]
    least_nu: ClassVar[float] = -1.0
    """Below this Poisson's ratio the energy has no lower bound, or rest is not its lowest state."""

    def __post_init__(self) -> None:
        try:
            moduli = elastic_moduli(E=self.E, nu=self.nu, K=self.K, lam=self.lam, mu=self.mu)
        except MaterialError as error:
            raise MaterialError(f"{type(self).__name__}: {error}") from None
        object.__setattr__(self, "moduli", moduli)
        for name in ("E", "nu", "K", "lam", "mu"):
            object.__setattr__(self, name, getattr(moduli, name))
        if np.min(moduli.nu) < self.least_nu:
            warnings.warn(
                f"{type(self).__name__}: for nu < {self.least_nu:g} a large deformation can have less energy than "
                f"rest (nu = {np.min(moduli.nu):g})",
                stacklevel=3,
            )

    @property
    def constitutive(self) -> Constitutive:
        return self.functions

    def parameters(self) -> tuple[Parameter, ...]:
        return self.moduli.mu, self.moduli.lam

    def _with_parameters(self, values: list[Parameter]) -> "HookeanMaterial":
        return type(self)(mu=values[0], lam=values[1])

    def with_lam(self, lam: Parameter) -> "HookeanMaterial":
        """The material of the same shear modulus with another ``lam`` [Pa]."""
        return type(self)(mu=self.mu, lam=lam)
