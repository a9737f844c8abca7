"""Hyperelastic materials. A new one is a file beside these and a line below."""

from warpfem.materials.base import Constitutive, HookeanMaterial, Material
from warpfem.materials.custom import EnergyMaterial
from warpfem.materials.fixed_corotated import FixedCorotated
from warpfem.materials.linear import LinearElasticity
from warpfem.materials.neo_hookean import NeoHookean
from warpfem.materials.st_venant_kirchhoff import StVenantKirchhoff
from warpfem.materials.stable_neo_hookean import StableNeoHookean

MATERIALS: dict[str, type[HookeanMaterial]] = {
    material.name: material
    for material in (LinearElasticity, StVenantKirchhoff, NeoHookean, FixedCorotated, StableNeoHookean)
}
"""The materials that E and nu determine, by name."""

__all__ = [
    "MATERIALS",
    "Constitutive",
    "EnergyMaterial",
    "FixedCorotated",
    "HookeanMaterial",
    "LinearElasticity",
    "Material",
    "NeoHookean",
    "StVenantKirchhoff",
    "StableNeoHookean",
]
