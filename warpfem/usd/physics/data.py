"""What a stage says of a simulation, as plain data in SI units: it crosses from the process that reads the stage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpfem.boundary import Obstacle


@dataclass(frozen=True, eq=False)
class Place:
    """Where the points of a prim are, and how they are stored.

    Attributes:
        path: of the prim.
        to_world: (4, 4) float64, takes row vectors from the prim's space to the world [m], at the start.
        points: (n, 3) float64 local positions at the start, in the stage's units.
        instances: paths of the instances above the prim, which must be opened before it can be changed.
    """

    path: str
    to_world: np.ndarray
    points: np.ndarray
    instances: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Follower:
    """A mesh that a body carries along.

    Attributes:
        place: the prim.
        bind_points: (n, 3) float64 positions [m] that belong to the body's ``bind_points``.
        normals: (k, 3) float64 local normals that belong to them; ``None`` if the prim has none that can follow.
        normal_points: (k,) the point that each normal is at.
        normals_name: the attribute that holds them.
        indexed: whether the prim has indices to them, which are to go: here each corner has its own.
    """

    place: Place
    bind_points: np.ndarray
    normals: np.ndarray | None = None
    normal_points: np.ndarray | None = None
    normals_name: str = "normals"
    indexed: bool = False


@dataclass(frozen=True, eq=False)
class StageBody:
    """A volume deformable.

    Arrays per point have the points that cells use, ``used`` of the prim's points.

    Attributes:
        name: unique in the stage.
        place: the prim with the tetrahedra.
        used: (n,) indices of the prim's points.
        cells: (m, 4) int32, indices of these n points, of either orientation.
        rest_points, start_points: (n, 3) float64 positions [m] at rest and at the start.
        velocities: (n, 3) float64 at the start [m/s].
        bind_points: (n, 3) float64 positions [m] to which the followers were fitted.
        youngs_modulus: [Pa], a number or (m,).
        poissons_ratio: likewise.
        density: [kg/m^3], likewise.
        material: the name of the material's model; "" if the stage names none.
        pins: points that are held, indices of the n points.
        followers: the meshes that it carries along.
    """

    name: str
    place: Place
    used: np.ndarray
    cells: np.ndarray
    rest_points: np.ndarray
    start_points: np.ndarray
    velocities: np.ndarray
    bind_points: np.ndarray
    youngs_modulus: float | np.ndarray
    poissons_ratio: float | np.ndarray
    density: float | np.ndarray
    material: str
    pins: np.ndarray
    followers: tuple[Follower, ...]


@dataclass(frozen=True, eq=False)
class StageScene:
    """A stage as a scene.

    Attributes:
        bodies: the volume deformables.
        gravity: acceleration [m/s^2]; ``None`` for none.
        obstacles: the colliders that stand still.
        up_axis: "Y" or "Z".
        fps: frames per second.
        frames: frames from the first time code to the last, ``None`` if the stage has no range.
        damping: mass-proportional damping [1/s].
        files: what the stage is made of.
    """

    bodies: tuple[StageBody, ...]
    gravity: tuple[float, float, float] | None
    obstacles: tuple[Obstacle, ...]
    up_axis: str
    fps: float
    frames: int | None
    damping: float
    files: tuple[str, ...]
