"""Stores a simulation in USD while it runs."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

from warpfem import __version__
from warpfem.dtypes import FloatName
from warpfem.scene import Scene
from warpfem.simulation import Frame, Simulation, Summary, body_slices


def record(simulation: Simulation, path: str | Path) -> Generator[Frame, None, None]:
    """Runs a simulation and stores each frame in the USD file ``path`` before it is yielded.

    If the run fails, is interrupted or the caller stops, the file holds the frames so far.

    Raises:
        OutputError: the file cannot be written; said before the first step where that can be known.
        SimulationError: the run cannot go on; the frames so far are in the file.
    """
    from warpfem.usd import BodyFrame, UsdBody, UsdWriter

    scene, model = simulation.scene, simulation.model
    bodies = [
        UsdBody(
            body.name,
            body.mesh.points,
            body.mesh.cells,
            body.mesh.boundary_faces if scene.dim == 3 else body.mesh.cells,
        )
        for body in scene.bodies
    ]
    rest = model.rest_points
    slices = body_slices(model)
    with UsdWriter(
        path,
        bodies,
        fps=scene.fps,
        up_axis=scene.up_axis,
        obstacles=scene.obstacles,
        color_by=scene.color_by,
        comment=f"warpfem {__version__}",
    ) as writer:
        for frame in simulation.frames():
            x = rest + frame.displacement
            writer.write_frame(
                [
                    BodyFrame(x[points], frame.velocity[points], frame.von_mises[cells], frame.jacobian[cells])
                    for points, cells in slices
                ]
            )
            yield frame


def run(scene: Scene, path: str | Path, *, device: str | None = None, dtype: FloatName = "float32") -> Summary:
    """Runs a scene and stores it in the USD file ``path``.

    Args:
        scene: the scene.
        path: output file, ``.usdc``, ``.usd`` or ``.usda``.
        device: Warp device, for example "cpu" or "cuda:0"; ``None`` takes Warp's default.
        dtype: "float32" or "float64".

    Returns:
        What the run did.

    Raises:
        SceneError, OutputError, SimulationError: as :class:`Simulation` and :func:`record`.
    """
    simulation = Simulation(scene, device=device, dtype=dtype)
    for _ in record(simulation, path):
        pass
    return simulation.summary
