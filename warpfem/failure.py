"""The state in which a run failed, in a file beside its output, for inspection."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpfem.files import beside, save_arrays
from warpfem.simulation import Simulation


def failure_path(output: str | Path) -> Path:
    """Where the state in which a run with this output failed is."""
    return beside(Path(output), "failed.npz")


def save_failure(path: Path, simulation: Simulation, error: Exception) -> None:
    """Writes the state of a simulation that cannot go on, numbers that are not finite included.

    The arrays are ``message``, ``time`` [s], ``step`` (steps taken), ``displacement`` [m] and ``velocity`` [m/s]
    (point_count, dim), ``jacobian`` (cell_count,), ``rest_points`` [m], ``bodies`` (names) and, for the i-th of
    them, ``cells_i``, which number the points of all bodies. An implicit step that failed leaves the state of its
    start; what it had come to is ``attempted_displacement``.

    Raises:
        OSError: the file cannot be written.
    """
    model, state = simulation.model, simulation.state
    jacobian, _ = model.diagnostics(state)
    arrays = {
        "message": np.array(str(error)),
        "time": np.array(state.time),
        "step": np.array(simulation.summary.steps),
        "displacement": state.displacement,
        "velocity": state.velocity,
        "jacobian": jacobian,
        "rest_points": model.rest_points,
        "bodies": np.array([body.name for body in model.scene.bodies]),
    }
    for index, (body, (points, _)) in enumerate(zip(model.scene.bodies, model.body_slices, strict=True)):
        arrays[f"cells_{index}"] = points.start + body.mesh.cells
    attempt = simulation.stepper.attempt
    if attempt is not None:
        arrays["attempted_displacement"] = attempt.numpy().astype(np.float64)
    save_arrays(path, arrays)
