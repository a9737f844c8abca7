"""What cases are tried on: materials, precisions and small meshes."""

from typing import Any

import numpy as np
import warp as wp

from warpfem.dtypes import FloatName
from warpfem.materials import MATERIALS, EnergyMaterial, HookeanMaterial, LinearElasticity, Material, StableNeoHookean
from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.moduli import elastic_moduli
from warpfem.scene import Body, Scene
from warpfem.solvers import SymplecticEuler

DTYPES: tuple[FloatName, ...] = ("float32", "float64")
EPSILON = {name: float(np.finfo(name).eps) for name in DTYPES}


@wp.func
def two_term_energy(F: wp.mat33d, parameters: Any):
    """The compressible Neo-Hookean psi as a user would write it."""
    log_j = wp.log(wp.determinant(F))
    half = wp.float64(0.5)
    shear = half * (wp.ddot(F, F) - wp.float64(3.0)) - log_j
    return parameters[0] * shear + half * parameters[1] * log_j * log_j


def custom(E: float, nu: float) -> EnergyMaterial:
    """A user's own energy density with these moduli."""
    moduli = elastic_moduli(E=E, nu=nu)
    return EnergyMaterial(two_term_energy, {"mu": moduli.mu, "lam": moduli.lam})


def hookean(E: float, nu: float) -> list[HookeanMaterial]:
    """The materials that E and nu determine."""
    return [kind(E=E, nu=nu) for kind in MATERIALS.values()]


def frugal(dim: int, E: float, nu: float) -> HookeanMaterial:
    """The material of that dimension that quick forms take, so that few kernels are compiled."""
    return LinearElasticity(E=E, nu=nu) if dim == 2 else StableNeoHookean(E=E, nu=nu)


def slab(dim: int, cells: int = 2, origin: float = 0.0) -> Mesh:
    """A body of 2 m x 1 m (x 1 m), ``cells`` squares or cubes across, from ``origin`` on all axes."""
    if dim == 2:
        return Mesh.rectangle((2.0, 1.0), (2 * cells, cells), (origin,) * 2)
    return Mesh.box((2.0, 1.0, 1.0), (2 * cells, cells, cells), (origin,) * 3)


def simplices(dim: int, count: int) -> Mesh:
    """Unit simplices that share no point, so that each has a deformation of its own."""
    corners = np.concatenate([np.zeros((1, dim)), np.eye(dim)])
    return Mesh(np.tile(corners, (count, 1)), np.arange(count * (dim + 1)).reshape(count, dim + 1))


def model_of(material: Material, mesh: Mesh, dtype: FloatName) -> Model:
    """The model of one body that nothing acts on."""
    return Model(Scene([Body("body", mesh, material)], SymplecticEuler()), device="cpu", dtype=dtype)


def label(*parts: object) -> str:
    """The name of a setting: materials by their class, a dimension as "2D"."""
    words = []
    for part in parts:
        if isinstance(part, Material):
            words.append(type(part).__name__)
        elif isinstance(part, int):
            words.append(f"{part}D")
        else:
            words.append(str(part))
    return ", ".join(words)


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """The rotation about an axis (3D) or in the plane (2D, ``axis`` is not used) by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    if len(axis) == 2:
        return np.array([[c, -s], [s, c]])
    n = axis / np.linalg.norm(axis)
    K = np.array([[0.0, -n[2], n[1]], [n[2], 0.0, -n[0]], [-n[1], n[0], 0.0]])
    return np.eye(3) + s * K + (1.0 - c) * (K @ K)
