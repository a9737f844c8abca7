"""The names of the proposed schemas, which no USD library knows yet, and what warpfem adds to them."""

BODY_API = "PhysicsDeformableBodyAPI"
SIMULATION_API = "PhysicsVolumeDeformableSimAPI"
MATERIAL_API = "PhysicsVolumeDeformableMaterialAPI"
POSE_API = "PhysicsDeformablePoseAPI"
ATTACHMENT = "PhysicsAttachment"

YOUNGS_MODULUS = "physics:youngsModulus"
POISSONS_RATIO = "physics:poissonsRatio"
DENSITY = "physics:density"
MASS = "physics:mass"
MASSES = "physics:masses"
REST_POINTS = "physics:restShapePoints"
REST_CELLS = "physics:restTetVertexIndices"

MODEL = "warpfem:material"
"""Token of a material: the name of a model in ``warpfem.MATERIALS``."""
DAMPING = "warpfem:damping"
"""Double of a physics scene: mass-proportional damping [1/s]."""
STIFFNESS = "warpfem:stiffness"
"""Double of a collider: pressure per depth of penetration [Pa/m]."""
NOT_HERE = "warpfem:notInStage"
"""String of a body: what the scene that wrote it had, and UsdPhysics has no words for."""

# What unauthored attributes mean in the proposal.
DEFAULT_YOUNGS_MODULUS = 1e6  # Pa
DEFAULT_POISSONS_RATIO = 0.3
DEFAULT_DENSITY = 1000.0  # kg/m^3
EARTH = 9.81
"""Acceleration [m/s^2] of a physics scene that gives none."""
