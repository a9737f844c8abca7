"""A log of a run: a line per frame with energies, extremes, the solver's work and how far the bodies have moved."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np

from warpfem.errors import OutputError, SceneError
from warpfem.files import replacing
from warpfem.log_file import FIGURES, check_log_path, head, read_log, row
from warpfem.model import Model
from warpfem.simulation import Frame, Simulation


@dataclass(frozen=True, eq=False)
class _Curve:
    """What displacement is averaged over.

    Attributes:
        name: what it is called.
        points: their numbers in the model, (k,).
        weights: with the sum 1, (k,).
    """

    name: str
    points: np.ndarray
    weights: np.ndarray


class RunLog:
    """Writes the log of a run, as a context manager; a line is on its way to the disk when its frame is done.

    The columns are those of ``FIGURES``, and ``BODY ux [m]`` and so on, the displacement of the centre of mass of
    each body, and ``BODY.SET ux [m]``, the mean displacement of the points of each of its named point sets. Steps and
    iterations are totals since the start of the run.
    """

    def __init__(self, path: str | Path, simulation: Simulation, last: int | None = None) -> None:
        """Checks everything that can be checked; nothing is written yet.

        Args:
            path: the log, ``.csv`` or ``.jsonl``.
            simulation: the run, not yet begun.
            last: the last frame to keep of the log that an earlier part of the run left; ``None`` begins anew.

        Raises:
            OutputError: the log cannot be written; there is none to go on with, or it is of another run.
            SceneError: two of its columns would have the same name.
        """
        check_log_path(path)
        self.path = Path(path)
        self._summary = simulation.summary
        self._curves = _curves(simulation.model)
        axes = "xyz"[: simulation.scene.dim]
        self._names = [*FIGURES, *(f"{curve.name} u{axis} [m]" for curve in self._curves for axis in axes)]
        for name in self._names:
            if self._names.count(name) > 1:
                raise SceneError(f"the log has two columns '{name}': give bodies and point sets other names")
        self._start = head(self.path, self._names) if last is None else self._kept(last)

    def add(self, frame: Frame) -> None:
        """Appends the line of a frame.

        Raises:
            OutputError: the disk takes no more.
        """
        energies, summary = frame.energies, self._summary
        values = [
            frame.index,
            frame.time,
            energies.kinetic,
            energies.elastic,
            energies.load,
            energies.contact,
            energies.total,
            float(frame.von_mises.max()),
            float(frame.jacobian.min()),
            frame.penetration,
            summary.steps,
            summary.newton_iterations,
            summary.cg_iterations,
            summary.unconverged_steps,
        ]
        for curve in self._curves:
            values += (curve.weights @ frame.displacement[curve.points]).tolist()
        try:
            self._file.write(row(self.path, self._names, values))
            self._file.flush()
        except OSError as error:
            raise OutputError(f"the log {self.path} cannot be written: {error}") from error

    def save(self) -> None:
        """Waits until all lines are on the disk for good.

        Raises:
            OutputError: the disk takes no more.
        """
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise OutputError(f"the log {self.path} cannot be written: {error}") from error

    def __enter__(self) -> RunLog:
        """Replaces what an earlier run left, but for what is kept."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(self.path) as temporary:
                temporary.write_text(self._start, encoding="utf-8")
            self._file = open(self.path, "a", encoding="utf-8", newline="\n")
        except OSError as error:
            raise OutputError(f"the log {self.path} cannot be written: {error}") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._file.close()

    def _kept(self, last: int) -> str:
        """The lines up to that of a frame."""
        table = read_log(self.path)
        if len(table.values) <= last or list(table.names) != self._names:
            raise OutputError(
                f"the log {self.path} is not one of the frames up to {last} of this run: leave --log out, or run anew"
            )
        return "".join(table.lines[: len(table.lines) - len(table.values) + last + 1])


def _curves(model: Model) -> list[_Curve]:
    curves = []
    for body, (own, _) in zip(model.scene.bodies, model.body_slices, strict=True):
        name = " ".join(body.name.split())  # a line is a line
        masses = model.host_mass[own]
        curves.append(_Curve(name, np.arange(own.start, own.stop), masses / masses.sum()))
        for label, members in body.mesh.point_sets.items():
            if not len(members):
                continue
            points = own.start + members
            curves.append(_Curve(f"{name}.{' '.join(label.split())}", points, np.full(len(points), 1.0 / len(points))))
    return curves
