"""Checkpoints: all that a run needs to go on from a frame as if it had never stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warpfem import __version__
from warpfem.boundary import Load, PointForce, PrescribedMotion, Support
from warpfem.errors import OutputError, SceneError, source_of, user_code
from warpfem.files import beside, save_arrays
from warpfem.materials import EnergyMaterial, Material
from warpfem.mesh import Mesh
from warpfem.scene import Body, Scene
from warpfem.simulation import Simulation

_FORMAT = 1
_MOTION_TIMES = 5
"""Prescribed motions are compared at so many times up to that of the checkpoint."""


def checkpoint_path(output: str | Path) -> Path:
    """Where the checkpoint of a run with this output is."""
    return beside(Path(output), "checkpoint.npz")


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The state of a run at a frame, and what it was a run of.

    Attributes:
        frame: index of the frame.
        time: simulated time [s], to the last bit.
        displacement, velocity: (point_count, dim) [m] and [m/s], in the precision of the run.
        summary: the summary at that frame, as :meth:`Summary.totals` gives it.
        parts: a digest of each part of the scene that determines the run, by its name.
        meshes: the mesh of each body.
        recipe: what the scene was made by, or "".
    """

    frame: int
    time: float
    displacement: np.ndarray
    velocity: np.ndarray
    summary: Mapping[str, Any]
    parts: Mapping[str, str]
    meshes: Sequence[Mesh]
    recipe: str

    @classmethod
    def of(cls, simulation: Simulation, frame: int, parts: Mapping[str, str], recipe: str) -> Checkpoint:
        """That of a simulation which has just come to ``frame``, whose :func:`scene_parts` are given."""
        state = simulation.state
        return cls(
            frame,
            state.time,
            state.u.numpy().copy(),
            state.v.numpy().copy(),
            simulation.summary.totals(),
            {**parts, **_motion_parts(simulation, state.time)},
            [body.mesh for body in simulation.scene.bodies],
            recipe,
        )

    @classmethod
    def read(cls, path: Path) -> Checkpoint:
        """Reads a checkpoint.

        Raises:
            OutputError: there is none, it is damaged, or of another version.
        """
        try:
            with np.load(path, allow_pickle=False) as arrays:
                header = json.loads(str(arrays["header"]))
                if header["format"] == _FORMAT:
                    fields = {name: header[name] for name in ("frame", "time", "summary", "parts", "recipe")}
                    fields |= {name: arrays[name] for name in ("displacement", "velocity")}
                    sets = header["sets"]
                    return cls(meshes=[_mesh(arrays, index, own) for index, own in enumerate(sets)], **fields)
        except FileNotFoundError:
            raise OutputError(
                f"there is no checkpoint {path} to resume from: a run writes it with --checkpoint-every N"
            ) from None
        except Exception as error:  # whatever damage leads to in a zip file, an array or JSON
            raise OutputError(f"the checkpoint {path} is damaged ({type(error).__name__}: {error})") from error
        raise OutputError(f"the checkpoint {path} has format {header['format']}; this warpfem reads {_FORMAT}")

    def write(self, path: Path) -> None:
        """Writes the checkpoint in place of an older one, at one stroke.

        Raises:
            OutputError: it cannot be written; an older one stays.
        """
        header = {
            "format": _FORMAT,
            "frame": self.frame,
            "time": self.time,
            "summary": self.summary,
            "parts": self.parts,
            "recipe": self.recipe,
            "sets": [[list(mesh.point_sets), list(mesh.cell_sets)] for mesh in self.meshes],
        }
        meshes: dict[str, np.ndarray] = {}
        for index, mesh in enumerate(self.meshes):
            meshes |= {f"points_{index}": mesh.points, f"cells_{index}": mesh.cells}
            for kind, sets in enumerate((mesh.point_sets, mesh.cell_sets)):
                meshes |= {f"set_{index}_{kind}_{number}": own for number, own in enumerate(sets.values())}
        try:
            save_arrays(
                path,
                {
                    "header": np.array(json.dumps(header, default=lambda number: number.item())),
                    "displacement": self.displacement,
                    "velocity": self.velocity,
                    **meshes,
                },
            )
        except OSError as error:
            raise OutputError(f"the checkpoint {path} cannot be written: {error}") from error

    def with_meshes(self, scene: Scene, recipe: str) -> Scene:
        """The scene with the meshes of this checkpoint, if it was made by the same recipe.

        Some meshes come out different each time that they are made: those of fTetWild do. What a scene says
        of their points by indices or arrays is not made to fit; :meth:`require_fit` finds that.
        """
        names = [f"body '{body.name}': the mesh" for body in scene.bodies]
        if not recipe or recipe != self.recipe or not all(name in self.parts for name in names):
            return scene
        try:
            bodies = [replace(body, mesh=mesh) for body, mesh in zip(scene.bodies, self.meshes, strict=True)]
            return replace(scene, bodies=bodies)
        except SceneError:  # an array per cell
            return scene

    def require_fit(self, simulation: Simulation, parts: Mapping[str, str], path: Path) -> None:
        """Checks that this is a checkpoint of the same run, but perhaps with another number of frames.

        Args:
            simulation: the run that is to go on.
            parts: its :func:`scene_parts`.
            path: the file, for the message.

        Raises:
            OutputError: names the parts that differ.
        """
        own = {**parts, **_motion_parts(simulation, self.time)}
        different = [name for name in {**self.parts, **own} if self.parts.get(name) != own.get(name)]
        if different:
            raise OutputError(
                f"the checkpoint {path} is of another run: {', '.join(different)} "
                f"{'differs' if len(different) == 1 else 'differ'}. Give the same scene and options, or run it anew"
            )
        if self.frame > simulation.scene.frames:
            raise OutputError(
                f"the checkpoint {path} is of frame {self.frame}, but the run has only {simulation.scene.frames} frames"
            )


def _mesh(arrays: Mapping[str, np.ndarray], index: int, names: tuple[list[str], list[str]]) -> Mesh:
    sets = [
        {name: arrays[f"set_{index}_{kind}_{number}"] for number, name in enumerate(own)}
        for kind, own in enumerate(names)
    ]
    return Mesh(arrays[f"points_{index}"], arrays[f"cells_{index}"], *sets)


def scene_parts(simulation: Simulation) -> dict[str, str]:
    """A digest of each part of what determines a run, by its name, but for the number of frames and motions."""
    scene, model = simulation.scene, simulation.model
    parts: dict[str, Any] = {
        "warpfem's version": __version__,
        "Warp's version": wp.__version__,
        "the device": "cuda" if model.device.is_cuda else "cpu",
        "the precision": model.dtype,
        "the solver": _settings(simulation.solver),
        "dt": [simulation.dt, simulation.steps_per_frame],
        "fps": scene.fps,
        "gravity": None if scene.gravity is None else [float(component) for component in scene.gravity],
        "damping": scene.damping,
        "the obstacles": [repr(obstacle) for obstacle in scene.obstacles],
        "up_axis": scene.up_axis,
        "color_by": scene.color_by,
        "the names of the bodies": [body.name for body in scene.bodies],
    }
    for body in scene.bodies:
        parts |= {f"body '{body.name}': {name}": value for name, value in _body_parts(body)}
    return {name: _digest(value) for name, value in parts.items()}


def _motion_parts(simulation: Simulation, time: float) -> dict[str, str]:
    """Digests of the prescribed motions, which can only be known by their values: those up to ``time`` [s]."""
    parts = {}
    for body in simulation.scene.bodies:
        motions = [support for support in body.supports if isinstance(support, PrescribedMotion)]
        if motions:
            with user_code(f"body '{body.name}', prescribed motion", source_of(motions[0].motion)):
                places = [_places(body, motion, time) for motion in motions]
            parts[f"body '{body.name}': the prescribed motion"] = _digest(places)
    return parts


def _places(body: Body, support: PrescribedMotion, time: float) -> list[np.ndarray]:
    rest = body.mesh.points[body.mesh.select_points(support.points)]
    return [np.asarray(support.motion(rest.copy(), float(t))) for t in np.linspace(0.0, time, _MOTION_TIMES)]


def _body_parts(body: Body) -> Iterator[tuple[str, Any]]:
    yield "the mesh", [body.mesh.points, body.mesh.cells]
    yield "the element", body.element
    yield "the material", _material(body.material, body.mesh.cell_count)
    yield "the density", body.density
    yield "the supports", [_support(body, support) for support in body.supports]
    yield "the loads", [_load(body, load) for load in body.loads]
    yield "the initial displacement", None if body.displacement is None else body.initial_displacement()
    yield "the initial velocity", None if body.velocity is None else body.initial_velocity()


def _material(material: Material, cell_count: int) -> list:
    source = [material.psi.adj.source, material.isotropic] if isinstance(material, EnergyMaterial) else []
    return [type(material).__name__, material.parameter_rows(cell_count), *source]


def _support(body: Body, support: Support) -> list:
    axes = None if support.axes is None else np.atleast_1d(support.axes).tolist()
    return [type(support).__name__, body.mesh.select_points(support.points), axes]


def _load(body: Body, load: Load) -> list:
    if isinstance(load, PointForce):
        return ["PointForce", body.mesh.select_points(load.points), load.force]
    return ["Traction", body.mesh.select_faces(load.points), load.traction]


def _settings(solver: object) -> str:
    name = f"{type(solver).__module__}.{type(solver).__qualname__}"
    return f"{name} {solver!r}" if is_dataclass(solver) else name


def _digest(value: Any) -> str:
    return hashlib.sha256(_plain(value)).hexdigest()


def _plain(value: Any) -> bytes:
    """Bytes that are equal for equal values: arrays by their contents, the rest by its text."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes()
    if isinstance(value, list | tuple):
        return b"[" + b",".join(hashlib.sha256(_plain(item)).digest() for item in value) + b"]"
    return repr(value).encode()
