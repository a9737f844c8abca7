"""warpfem: finite element simulation of elastic solids on NVIDIA Warp, stored as USD animations.

import warpfem as wf

mesh = wf.Mesh.box(size=(1, 1, 1), cells=(8, 8, 8), origin=(0, 0.5, 0))
body = wf.Body("jelly", mesh, wf.StableNeoHookean(E=1e5, nu=0.45), density=1000)
scene = wf.Scene([body], wf.BackwardEuler(), gravity=(0, -9.81, 0), obstacles=[wf.Plane((0, 0, 0), (0, 1, 0))])
wf.run(scene, "jelly.usdc")
"""

__version__ = "0.1.0"

from warpfem import quantities
from warpfem.boundary import Box, BoxWalls, Pin, Plane, PointForce, PrescribedMotion, Sphere, Traction
from warpfem.errors import (
    MaterialError,
    MeshError,
    MissingExtraError,
    OutputError,
    SceneError,
    SimulationError,
    WarpfemError,
)
from warpfem.materials import (
    MATERIALS,
    EnergyMaterial,
    FixedCorotated,
    LinearElasticity,
    NeoHookean,
    StableNeoHookean,
    StVenantKirchhoff,
)
from warpfem.mesh import Mesh
from warpfem.meshing import load_mesh, read_surface, tetrahedralize
from warpfem.model import Energies, Model, State, Stresses
from warpfem.moduli import ElasticModuli, elastic_moduli
from warpfem.reactions import PointForces, Reactions, reactions
from warpfem.record import record, run
from warpfem.scene import Body, Scene
from warpfem.simulation import Frame, Simulation, Summary
from warpfem.solvers import (
    SDIRK2,
    SDIRK3,
    SOLVERS,
    BackwardEuler,
    ImplicitMidpoint,
    Quasistatic,
    StaticEquilibrium,
    SymplecticEuler,
    VelocityVerlet,
)
from warpfem.stage import read_stage
from warpfem.static_run import run_static

__all__ = [
    "MATERIALS",
    "SDIRK2",
    "SDIRK3",
    "SOLVERS",
    "BackwardEuler",
    "Body",
    "Box",
    "BoxWalls",
    "ElasticModuli",
    "Energies",
    "EnergyMaterial",
    "FixedCorotated",
    "Frame",
    "ImplicitMidpoint",
    "LinearElasticity",
    "MaterialError",
    "Mesh",
    "MeshError",
    "MissingExtraError",
    "Model",
    "NeoHookean",
    "OutputError",
    "Pin",
    "Plane",
    "PointForce",
    "PointForces",
    "PrescribedMotion",
    "Quasistatic",
    "Reactions",
    "Scene",
    "SceneError",
    "Simulation",
    "SimulationError",
    "Sphere",
    "StVenantKirchhoff",
    "StableNeoHookean",
    "State",
    "StaticEquilibrium",
    "Stresses",
    "Summary",
    "SymplecticEuler",
    "Traction",
    "VelocityVerlet",
    "WarpfemError",
    "elastic_moduli",
    "load_mesh",
    "quantities",
    "reactions",
    "read_stage",
    "read_surface",
    "record",
    "run",
    "run_static",
    "tetrahedralize",
]
