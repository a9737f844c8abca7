"""Stores a simulation in USD while it runs."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpfem import __version__
from warpfem.checkpoint import Checkpoint, checkpoint_path, scene_parts
from warpfem.dtypes import FloatName
from warpfem.errors import OutputError, SimulationError
from warpfem.failure import failure_path, save_failure
from warpfem.files import remove
from warpfem.log import RunLog
from warpfem.model import Model
from warpfem.scene import Scene
from warpfem.simulation import Frame, Simulation, Summary
from warpfem.stage import physics_of

if TYPE_CHECKING:
    from warpfem.usd import BodyFrame, UsdBody, UsdWriter

COMMENT = f"warpfem {__version__}"
"""What files say of where they come from."""


def record(
    simulation: Simulation,
    path: str | Path,
    *,
    checkpoint_every: int | None = None,
    resume: bool = False,
    recipe: str = "",
    log: str | Path | None = None,
    over: str | Path | None = None,
) -> Generator[Frame, None, None]:
    """Runs a simulation and stores each frame in the USD file ``path`` while the next one is computed.

    If the run fails, is interrupted or the caller stops, the file holds the frames so far. A file that exists is
    overwritten, and so are the partial file, the checkpoint and the failed state that an earlier run of the same
    ``path`` left, unless it is resumed. A run that cannot go on leaves the state in which it failed in
    ``<stem>.failed.npz``.

    Args:
        simulation: the simulation, not yet run.
        path: output file, ``.usdc``, ``.usd`` or ``.usda``.
        checkpoint_every: frames between two checkpoints, which are kept in ``<stem>.checkpoint.npz`` until the
            run has come to its end; ``None`` writes none.
        resume: go on after the checkpoint of an earlier run of the same scene, with the frames that it left.
            The frames after the checkpoint are computed again, and yielded.
        recipe: what the scene was made by, for :meth:`Checkpoint.with_meshes`.
        over: the USD stage that the scene was read from: ``path`` then becomes a layer over it, with nothing but the
            motion. Such runs have no checkpoints.

        log: a ``.csv`` or ``.jsonl`` that gets a line per frame, of energies, extremes, the solver's work and mean
            displacements: see :class:`warpfem.log.RunLog`. A resumed run goes on in it.

    Raises:
        OutputError: the file or the log cannot be written; there is nothing to resume, or it is of another scene. Said
            before the first step where that can be known, and then nothing has been changed.
        SimulationError: the run cannot go on; the frames so far are in the file.
    """
    from warpfem.usd import BackgroundWriter, FrameWriter, OverWriter

    if checkpoint_every is not None and not (isinstance(checkpoint_every, int) and checkpoint_every >= 1):
        raise OutputError(f"checkpoint_every must be a number of frames of at least 1, not {checkpoint_every!r}")
    if over is not None and (checkpoint_every or resume):
        raise OutputError(f"{path}: a layer over a stage has no checkpoints: run without, or without the stage")
    scene, summary = simulation.scene, simulation.summary
    checkpoint_file, failure_file = checkpoint_path(path), failure_path(path)
    for file in (checkpoint_file, failure_file):
        if file.is_dir():
            raise OutputError(f"{file} is a folder: move it away, a run of {path} needs the name")
    parts = scene_parts(simulation) if checkpoint_every or resume else {}
    start, keep = None, None
    if resume:
        start = Checkpoint.read(checkpoint_file)
        start.require_fit(simulation, parts, checkpoint_file)
        frame = simulation.restore(start.frame, start.time, start.displacement, start.velocity)
        keep = start.frame, body_frames(simulation.model, frame)
    run_log = None if log is None else RunLog(log, simulation, None if start is None else start.frame)
    expected_frames = scene.frames + 1
    usd_writer: FrameWriter
    if over is not None:
        names = [body.name for body in scene.bodies]
        usd_writer = OverWriter(path, over, names, fps=scene.fps, comment=COMMENT, expected_frames=expected_frames)
    else:
        usd_writer = scene_writer(path, scene, keep=keep, expected_frames=expected_frames)
    with BackgroundWriter(usd_writer) as writer, run_log or contextlib.nullcontext():
        _remove(failure_file)
        if start is None:
            _remove(checkpoint_file)
        else:
            summary.take_up(start.summary)

        def save_checkpoint(index: int) -> None:
            writer.flush()
            if run_log:
                run_log.save()
            Checkpoint.of(simulation, index, parts, recipe).write(checkpoint_file)

        with _failure_saved(simulation, failure_file):
            for frame in simulation.frames():
                writer.write_frame(body_frames(simulation.model, frame))
                if run_log:
                    run_log.add(frame)
                if checkpoint_every and frame.index % checkpoint_every == 0:
                    save_checkpoint(frame.index)
                try:
                    yield frame
                except GeneratorExit:
                    if checkpoint_every:
                        save_checkpoint(frame.index)
                    raise
    _remove(checkpoint_file)


def run(
    scene: Scene,
    path: str | Path,
    *,
    device: str | None = None,
    dtype: FloatName = "float32",
    checkpoint_every: int | None = None,
    resume: bool = False,
    threads: int | None = None,
    log: str | Path | None = None,
    over: str | Path | None = None,
) -> Summary:
    """Runs a scene and stores it in the USD file ``path``, which is overwritten if it exists.

    Args:
        scene: the scene.
        path: output file, ``.usdc``, ``.usd`` or ``.usda``.
        device: Warp device, for example "cpu" or "cuda:0"; ``None`` takes Warp's default.
        dtype: "float32" or "float64".
        checkpoint_every: frames between two checkpoints; ``None`` writes none.
        resume: go on after the checkpoint of an earlier run, which differs in the number of frames at most.
        threads: threads of the CPU that steps may use; ``None`` takes all cores. Results are the same.
        log: a ``.csv`` or ``.jsonl`` that gets a line per frame; ``None`` writes none.
        over: the USD stage that the scene was read from, for a layer over it; see :func:`record`.

    Returns:
        What the run did, with what came before the checkpoint.

    Raises:
        SceneError, OutputError, SimulationError: as :class:`Simulation` and :func:`record`.
    """
    simulation = Simulation(scene, device=device, dtype=dtype, threads=threads)
    for _ in record(simulation, path, checkpoint_every=checkpoint_every, resume=resume, log=log, over=over):
        pass
    return simulation.summary


def scene_writer(path: str | Path, scene: Scene, **options: Any) -> UsdWriter:
    """A writer of the frames of a scene, with other options of :class:`UsdWriter`."""
    from warpfem.usd import UsdWriter

    return UsdWriter(
        path,
        _usd_bodies(scene),
        fps=scene.fps,
        up_axis=scene.up_axis,
        obstacles=scene.obstacles,
        physics=physics_of(scene),
        color_by=scene.color_by,
        comment=COMMENT,
        **options,
    )


def _usd_bodies(scene: Scene) -> list[UsdBody]:
    """What the USD writer takes of the bodies."""
    from warpfem.usd import UsdBody

    return [
        UsdBody(
            body.name,
            body.mesh.points,
            body.mesh.linear_cells,
            body.mesh.linear_boundary_faces if scene.dim == 3 else body.mesh.linear_cells,
        )
        for body in scene.bodies
    ]


def body_frames(model: Model, frame: Frame) -> list[BodyFrame]:
    """What the USD writer takes of a frame, in arrays of its own."""
    from warpfem.usd import BodyFrame

    x = model.rest_points + frame.displacement
    frames = []
    for body, (points, cells) in zip(model.scene.bodies, model.body_slices, strict=True):
        parts = len(body.mesh.shape.parts)
        von_mises, jacobian = (np.repeat(values[cells], parts) for values in (frame.von_mises, frame.jacobian))
        frames.append(BodyFrame(x[points], frame.velocity[points].copy(), von_mises, jacobian))
    return frames


@contextlib.contextmanager
def _failure_saved(simulation: Simulation, path: Path) -> Iterator[None]:
    """Saves the state in which a simulation fails."""
    try:
        yield
    except SimulationError as error:
        try:
            save_failure(path, simulation, error)
        except OSError as problem:
            error.add_note(f"the state in which it failed cannot be written to {path}: {problem}")
        else:
            error.add_note(f"the state in which it failed is in {path}")
        raise


def _remove(path: Path) -> None:
    try:
        remove(path)
    except OSError as error:
        raise OutputError(f"{path} cannot be removed: {error}") from error
