"""Animations and meshes in USD: the only part of warpfem that imports ``pxr``.

:class:`UsdWriter` stores a run frame by frame, in a thread as a :class:`BackgroundWriter`;
:func:`read_animation` reads it back, and :func:`read_pictured_stage` any stage for pictures;
:func:`read_mesh` and :func:`read_surface_mesh` take meshes from files that others made. All of them speak numpy;
none knows of Warp, models or solvers.
"""

from warpfem.usd.animation import AnimatedBody, AnimatedFrame, Animation, read_animation
from warpfem.usd.background import BackgroundWriter
from warpfem.usd.bodies import BodyFrame, UsdBody
from warpfem.usd.colors import ColorQuantity, ColorScale, spread_of
from warpfem.usd.frames import FrameWriter, check_path
from warpfem.usd.meshes import read_mesh, read_surface_mesh
from warpfem.usd.over import OverWriter, frames_over, require_other_file
from warpfem.usd.physics.author import BodyPhysics, ScenePhysics, too_many_materials
from warpfem.usd.physics.reader import read_stage_scene
from warpfem.usd.pictured import PicturedStage, SurfaceFrame, read_pictured_stage
from warpfem.usd.saved import partial_path
from warpfem.usd.writer import UsdWriter

__all__ = [
    "AnimatedBody",
    "AnimatedFrame",
    "Animation",
    "BackgroundWriter",
    "BodyFrame",
    "BodyPhysics",
    "ColorQuantity",
    "ColorScale",
    "FrameWriter",
    "OverWriter",
    "PicturedStage",
    "ScenePhysics",
    "SurfaceFrame",
    "UsdBody",
    "UsdWriter",
    "check_path",
    "frames_over",
    "partial_path",
    "read_animation",
    "read_mesh",
    "read_pictured_stage",
    "read_stage_scene",
    "read_surface_mesh",
    "require_other_file",
    "spread_of",
    "too_many_materials",
]
