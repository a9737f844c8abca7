"""What several test files share: reference materials in NumPy, and models that evaluate materials at many F.

The references are the textbook forms in F, in float64, by determinants, inverses and singular value
decompositions: nothing of them is taken from the kernels. ``F`` is always 3x3; plane strain is diag(F, 1).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from warpfem.materials import EnergyMaterial, HookeanMaterial, Material
from warpfem.mesh import Mesh
from warpfem.model import Model, State
from warpfem.moduli import Parameter
from warpfem.scene import Body, Scene
from warpfem.solvers import SymplecticEuler
from warpfem.stiffness import all_blocks, entry_count

IDENTITY = np.eye(3)
LEVI_CIVITA = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    LEVI_CIVITA[_i, _j, _k], LEVI_CIVITA[_k, _j, _i] = 1.0, -1.0


# ---- matrices


def random_rotation(rng: np.random.Generator, dim: int) -> np.ndarray:
    """A proper rotation, uniformly distributed."""
    Q, R = np.linalg.qr(rng.normal(size=(dim, dim)))
    Q = Q * np.sign(np.diag(R))
    Q[:, 0] *= np.sign(np.linalg.det(Q))
    return Q


def solid(F: np.ndarray) -> np.ndarray:
    """(..., 3, 3): a 2x2 deformation gradient in plane strain is diag(F, 1)."""
    if F.shape[-1] == 3:
        return F
    result = np.zeros((*F.shape[:-2], 3, 3))
    result[..., :2, :2], result[..., 2, 2] = F, 1.0
    return result


def cofactor(F: np.ndarray) -> np.ndarray:
    """dJ/dF, by the definition: eps eps F F / 2."""
    return 0.5 * np.einsum("ikm,jln,kl,mn->ij", LEVI_CIVITA, LEVI_CIVITA, F, F)


def polar_rotation(F: np.ndarray) -> np.ndarray:
    """The proper rotation closest to F, 2x2 or 3x3."""
    U, _, Vt = np.linalg.svd(F)
    sign = np.ones(len(F))
    sign[-1] = np.sign(np.linalg.det(U @ Vt))
    return (U * sign) @ Vt


# ---- materials


@dataclass(frozen=True)
class Reference:
    """psi, P and the tangent dP_ij/dF_kl of one material at a 3x3 F, from mu and lam."""

    energy_density: Callable[[np.ndarray, float, float], float]
    stress: Callable[[np.ndarray, float, float], np.ndarray]
    tangent: Callable[[np.ndarray, float, float], np.ndarray]


def _outer(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    return np.einsum("ij,kl->ijkl", A, B)


_SAME = np.einsum("ik,jl->ijkl", IDENTITY, IDENTITY)  # dF_ij/dF_kl
_TRANSPOSED = np.einsum("il,jk->ijkl", IDENTITY, IDENTITY)


def _linear() -> Reference:
    def strain(F):
        return 0.5 * (F + F.T) - IDENTITY

    return Reference(
        lambda F, mu, lam: mu * np.sum(strain(F) ** 2) + 0.5 * lam * np.trace(strain(F)) ** 2,
        lambda F, mu, lam: 2.0 * mu * strain(F) + lam * np.trace(strain(F)) * IDENTITY,
        lambda F, mu, lam: mu * (_SAME + _TRANSPOSED) + lam * _outer(IDENTITY, IDENTITY),
    )


def _st_venant_kirchhoff() -> Reference:
    def strain(F):
        return 0.5 * (F.T @ F - IDENTITY)

    def second_piola(F, mu, lam):
        return 2.0 * mu * strain(F) + lam * np.trace(strain(F)) * IDENTITY

    def tangent(F, mu, lam):
        C = mu * (_SAME + _TRANSPOSED) + lam * _outer(IDENTITY, IDENTITY)
        geometric = np.einsum("ik,lj->ijkl", IDENTITY, second_piola(F, mu, lam))
        return geometric + np.einsum("im,mjnl,kn->ijkl", F, C, F)

    return Reference(
        lambda F, mu, lam: mu * np.sum(strain(F) ** 2) + 0.5 * lam * np.trace(strain(F)) ** 2,
        lambda F, mu, lam: F @ second_piola(F, mu, lam),
        tangent,
    )


def _neo_hookean() -> Reference:
    def energy(F, mu, lam):
        J = np.linalg.det(F)
        if J <= 0.0:
            return np.inf
        return 0.5 * mu * (np.sum(F * F) - 3.0) - mu * np.log(J) + 0.5 * lam * np.log(J) ** 2

    def stress(F, mu, lam):
        G = np.linalg.inv(F).T
        return mu * (F - G) + lam * np.log(np.linalg.det(F)) * G

    def tangent(F, mu, lam):
        G = np.linalg.inv(F).T
        pressure = mu - lam * np.log(np.linalg.det(F))
        return mu * _SAME + pressure * np.einsum("il,kj->ijkl", G, G) + lam * _outer(G, G)

    return Reference(energy, stress, tangent)


def _stable_neo_hookean() -> Reference:
    def constants(mu, lam):
        mu, lam = 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu
        return mu, lam, 1.0 + 0.75 * mu / lam

    def unshifted(F, mu, lam):
        mu, lam, alpha = constants(mu, lam)
        I_C = np.sum(F * F)
        return 0.5 * mu * (I_C - 3.0 - np.log(I_C + 1.0)) + 0.5 * lam * (np.linalg.det(F) - alpha) ** 2

    def stress(F, mu, lam):
        mu, lam, alpha = constants(mu, lam)
        I_C = np.sum(F * F)
        return mu * (1.0 - 1.0 / (I_C + 1.0)) * F + lam * (np.linalg.det(F) - alpha) * cofactor(F)

    def tangent(F, mu, lam):
        mu, lam, alpha = constants(mu, lam)
        I_C = np.sum(F * F)
        shear = mu * (1.0 - 1.0 / (I_C + 1.0)) * _SAME + 2.0 * mu / (I_C + 1.0) ** 2 * _outer(F, F)
        return shear + _volumetric_tangent(F, lam, np.linalg.det(F) - alpha)

    return Reference(
        lambda F, mu, lam: unshifted(F, mu, lam) - unshifted(IDENTITY, mu, lam),
        stress,
        tangent,
    )


def _volumetric_tangent(F: np.ndarray, lam: float, j: float) -> np.ndarray:
    """That of lam/2 j^2, where j is J less a constant."""
    C = cofactor(F)
    return lam * _outer(C, C) + lam * j * np.einsum("ikm,jln,mn->ijkl", LEVI_CIVITA, LEVI_CIVITA, F)


def _fixed_corotated() -> Reference:
    def energy(F, mu, lam):
        return mu * np.sum((F - polar_rotation(F)) ** 2) + 0.5 * lam * (np.linalg.det(F) - 1.0) ** 2

    def stress(F, mu, lam):
        return 2.0 * mu * (F - polar_rotation(F)) + lam * (np.linalg.det(F) - 1.0) * cofactor(F)

    def tangent(F, mu, lam):
        # R changes with the twists (u_i v_j^T - u_j v_i^T)/sqrt 2 alone, at the rate 2/(s_i + s_j)
        U, s, Vt = np.linalg.svd(F)
        sign = np.sign(np.linalg.det(U @ Vt))
        U[:, 2] *= sign
        s[2] *= sign
        rotation_rate = np.zeros((3, 3, 3, 3))
        for i, j in ((0, 1), (1, 2), (0, 2)):
            twist = (np.outer(U[:, i], Vt[j]) - np.outer(U[:, j], Vt[i])) / np.sqrt(2.0)
            rotation_rate += 2.0 / (s[i] + s[j]) * _outer(twist, twist)
        return 2.0 * mu * (_SAME - rotation_rate) + _volumetric_tangent(F, lam, np.linalg.det(F) - 1.0)

    return Reference(energy, stress, tangent)


REFERENCES = {
    "linear": _linear(),
    "st_venant_kirchhoff": _st_venant_kirchhoff(),
    "neo_hookean": _neo_hookean(),
    "fixed_corotated": _fixed_corotated(),
    "stable_neo_hookean": _stable_neo_hookean(),
}
"""By the name of the material in ``warpfem.materials.MATERIALS``."""


def filtered(tangent: np.ndarray, kind: str) -> np.ndarray:
    """A (d, d, d, d) tangent with "absolute" or "clamped" eigenvalues, by an eigendecomposition."""
    d = len(tangent)
    values, vectors = np.linalg.eigh(tangent.reshape(d * d, d * d))
    values = np.abs(values) if kind == "absolute" else np.maximum(values, 0.0)
    return ((vectors * values) @ vectors.T).reshape(d, d, d, d)


@wp.func
def neo_hookean_energy(F: wp.mat33d, parameters: Any):
    """The Neo-Hookean psi as a user would write it."""
    log_j = wp.log(wp.determinant(F))
    half = wp.float64(0.5)
    shear = half * (wp.ddot(F, F) - wp.float64(3.0)) - log_j
    return parameters[0] * shear + half * parameters[1] * log_j * log_j


def custom_neo_hookean(mu: Parameter, lam: Parameter) -> EnergyMaterial:
    """The Neo-Hookean material from psi alone."""
    return EnergyMaterial(neo_hookean_energy, {"mu": mu, "lam": lam})


# ---- models


def model_of(material: Material, mesh: Mesh, dtype: str = "float64", **body: Any) -> Model:
    """The model of one body."""
    return Model(Scene([Body("body", mesh, material, **body)], SymplecticEuler()), device="cpu", dtype=dtype)


def irregular_mesh(dim: int, seed: int = 3) -> Mesh:
    """A small rectangle or box whose points, also those of the boundary, are off the grid."""
    mesh = Mesh.rectangle((1.0, 0.8), (4, 3)) if dim == 2 else Mesh.box((1.0, 0.8, 0.9), (3, 2, 2))
    shift = 0.06 * np.random.default_rng(seed).uniform(-1.0, 1.0, mesh.points.shape)
    return Mesh(mesh.points + shift, mesh.cells, mesh.point_sets)


class Samples:
    """A material evaluated by the element kernels at many deformation gradients, one unit simplex for each.

    Attributes:
        material: with uniform parameters.
        F: (n, d, d), what the cells have to rounding in ``H = F - I``.
        model: of n cells that share no point.
        state: the state that has these F.
    """

    def __init__(self, material: Material, F: np.ndarray, dtype: str = "float64", H: np.ndarray | None = None) -> None:
        n, dim, _ = F.shape
        simplex = np.concatenate([np.zeros((1, dim)), np.eye(dim)])
        mesh = Mesh(np.tile(simplex, (n, 1)), np.arange(n * (dim + 1)).reshape(n, dim + 1))
        self.material = material
        self.F = F
        self.dim = dim
        self.model = model_of(material, mesh, dtype)
        self.volume = mesh.cell_volumes[0]
        H = F - np.eye(dim) if H is None else H
        displacement = np.zeros((n, dim + 1, dim))
        displacement[:, 1:] = H.transpose(0, 2, 1)  # the k-th corner moves by H e_k
        self.state: State = self.model.state()
        self.state.assign(displacement=displacement.reshape(-1, dim))

    @cached_property
    def energy_density(self) -> np.ndarray:
        """(n,) float64: one launch per cell, because the kernel adds up."""
        (block,) = self.model.blocks
        energy = wp.zeros(len(self.F), dtype=wp.float64, device=self.model.device)
        for i in range(len(self.F)):
            block.launch("energy", [self.state.u], [energy[i : i + 1]], part=slice(i, i + 1))
        return energy.numpy() / self.volume

    @cached_property
    def stress(self) -> np.ndarray:
        """P (n, d, d) from the forces on the corners."""
        force = self.model.internal_force(self.state).reshape(-1, self.dim + 1, self.dim)
        return -force[:, 1:].transpose(0, 2, 1) / self.volume

    @cached_property
    def solid_stress(self) -> np.ndarray:
        """P (n, 3, 3) from the stress kernel, with the part out of the plane."""
        return self.model.stresses(self.state).first_piola_kirchhoff

    @cached_property
    def tangent(self) -> np.ndarray:
        """dP_ij/dF_kl (n, d, d, d, d) from the elements' stiffness."""
        return self._tangent("stiffness")

    def filtered_tangent(self, kind: str) -> np.ndarray:
        """The same from the stiffness made positive semi-definite, "absolute" or "clamped"."""
        return self._tangent(f"{kind}_stiffness")

    def _tangent(self, kernel: str) -> np.ndarray:
        (block,) = self.model.blocks
        n, d = len(self.F), self.dim
        stored = wp.zeros(entry_count(n, d + 1), dtype=self.model.types.matrix, device=self.model.device)
        block.launch(kernel, [self.state.u], [stored])
        K = all_blocks(stored.numpy(), n, d + 1)
        return K[:, 1:, 1:].transpose(0, 3, 1, 4, 2) / self.volume  # K[j, l, i, k] couples F_ij and F_kl


class ReferenceSamples:
    """The same by the NumPy reference."""

    def __init__(self, material: HookeanMaterial, F: np.ndarray) -> None:
        reference = REFERENCES[material.name]
        moduli = float(material.mu), float(material.lam)  # type: ignore[arg-type]
        solids = solid(np.asarray(F, dtype=np.float64))
        d = F.shape[-1]
        self.energy_density = np.array([reference.energy_density(f, *moduli) for f in solids])
        self.solid_stress = np.array([reference.stress(f, *moduli) for f in solids])
        self.stress = self.solid_stress[:, :d, :d]
        self.tangent = np.array([reference.tangent(f, *moduli) for f in solids])[:, :d, :d, :d, :d]


def relative_error(actual: np.ndarray, expected: np.ndarray, scale: float | np.ndarray = 0.0) -> float:
    """The largest |actual - expected| / |expected| over the entries of the first axis, or over ``scale`` if larger."""
    axes = tuple(range(1, expected.ndim))
    difference = np.sqrt(np.sum((actual - expected) ** 2, axis=axes))
    size = np.maximum(np.sqrt(np.sum(expected**2, axis=axes)), scale)
    return float(np.max(difference / size))


def assert_routes_agree(model: Model, state: State, p: np.ndarray, rounding: float) -> None:
    """The force differential along p is the difference of forces, and the same to rounding by all routes."""
    forces = []
    for sign in (1, -1):
        moved = model.state()
        moved.assign(displacement=state.displacement + sign * 1e-6 * p)
        forces.append(model.internal_force(moved))
    expected = (forces[0] - forces[1]) / 2e-6
    scale = np.abs(expected).max()
    closed = model.force_differential(state, p, "closed")
    np.testing.assert_allclose(closed, expected, atol=1e-7 * scale)
    for route in ("tape", "assembled"):
        np.testing.assert_allclose(model.force_differential(state, p, route), closed, atol=rounding * scale)
