"""Solves a scene's static equilibrium and stores it in USD."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import warp as wp

from warpfem.dtypes import FloatName
from warpfem.errors import SceneError
from warpfem.model import Energies, Model
from warpfem.reactions import PointForces, Reactions, reactions
from warpfem.record import body_frames, scene_writer
from warpfem.scene import Scene
from warpfem.simulation import Frame, observe
from warpfem.solvers.static import StaticEquilibrium, at_rest, require_solvable


@dataclass(frozen=True)
class Force:
    """A sum of forces.

    Attributes:
        name: what exerts them.
        force: their sum [N].
        moment: the sum of their moments about the origin [N m], of length 1 in 2D.
    """

    name: str
    force: tuple[float, ...]
    moment: tuple[float, ...]


@dataclass
class StaticSummary:
    """What a static solve found.

    Attributes:
        time: when prescribed motions were held [s].
        setup_seconds: wall time to build the model [s].
        solving_seconds: wall time of the solves, and of compiling or loading their kernels [s].
        fractions: the parts of the load under which equilibria were found, 1 at the end.
        newton_iterations, cg_iterations: totals over all of them.
        residual: largest unbalanced force at the last of them, relative to the largest of those acting.
        note: how that solve ended, if not by its tolerance.
        linear_solver: what solved its linear systems, and why.
        stable: whether the stiffness at the end has no direction of negative curvature.
        energies: energies at the last of them [J], likewise all that follows.
        largest_displacement: [m].
        largest_von_mises: [Pa].
        smallest_jacobian: J.
        largest_penetration: depth inside an obstacle [m].
        supports, obstacles: what each of them exerts.
        loads: gravity, point forces and tractions at their full value.
        unbalanced: the sum of all forces.
    """

    time: float
    setup_seconds: float
    solving_seconds: float = 0.0
    fractions: tuple[float, ...] = ()
    newton_iterations: int = 0
    cg_iterations: int = 0
    residual: float = 0.0
    note: str = ""
    linear_solver: str = ""
    stable: bool = True
    energies: Energies | None = None
    largest_displacement: float = 0.0
    largest_von_mises: float = 0.0
    smallest_jacobian: float = 1.0
    largest_penetration: float = 0.0
    supports: tuple[Force, ...] = ()
    obstacles: tuple[Force, ...] = ()
    loads: Force | None = None
    unbalanced: Force | None = None

    def add_forces(self, found: Reactions) -> None:
        """Takes the sums of the forces of the equilibrium."""
        self.supports = tuple(_force(part) for part in found.supports)
        self.obstacles = tuple(_force(part) for part in found.obstacles)
        self.loads = _force(found.loads)
        self.unbalanced = Force("sum", tuple(found.total.tolist()), tuple(found.moment().tolist()))


def _force(part: PointForces) -> Force:
    return Force(part.name, tuple(part.total.tolist()), tuple(part.moment().tolist()))


class StaticRun:
    """A scene's static equilibrium, solved from its initial displacement.

    Velocities and damping do not matter.

    Args:
        scene: the scene.
        solver: the settings.
        time: when prescribed motions are held [s]; ``None`` for the time of the last frame.
        device: Warp device, for example "cpu" or "cuda:0"; ``None`` takes Warp's default.
        dtype: "float64", or "float32", whose rounding can hide what is left of the forces.

    Attributes:
        scene: the scene.
        model: the scene on the device.
        state: the last equilibrium found.
        summary: what has been found so far.

    Raises:
        SceneError: as :class:`Model` and :meth:`StaticEquilibrium.solve`.
    """

    def __init__(
        self,
        scene: Scene,
        solver: StaticEquilibrium | None = None,
        *,
        time: float | None = None,
        device: str | None = None,
        dtype: FloatName = "float64",
    ) -> None:
        start = _now()
        end = scene.frames / scene.fps if time is None else time
        if not 0.0 <= end < np.inf:
            raise SceneError(f"time must be a finite number >= 0, not {time!r}")
        self.scene = scene
        self.solver = solver or StaticEquilibrium()
        self.model = at_rest(Model(scene, device=device, dtype=dtype))
        require_solvable(self.model)
        self.state = self.model.state()
        # supports draw the bodies along, rather than start with their own points moved ahead
        self.state.assign(
            displacement=np.concatenate([body.initial_displacement() for body in scene.bodies]),
            velocity=np.zeros((self.model.point_count, scene.dim)),
        )
        self.summary = StaticSummary(end, _now() - start)

    def frames(self) -> Iterator[Frame]:
        """Solves; yields the start, and then a frame per equilibrium found on the way to the full load.

        Raises:
            SimulationError: as :meth:`StaticEquilibrium.increments`.
        """
        summary = self.summary
        yield observe(self.model, self.state, 0)
        increments = self.solver.increments(self.model, self.state, summary.time)
        index = 0
        while True:
            start = _now()
            increment = next(increments, None)
            wp.synchronize_device(self.model.device)
            summary.solving_seconds += _now() - start
            if increment is None:
                break
            index += 1
            frame = observe(self.model, self.state, index)
            summary.fractions += (increment.fraction,)
            summary.newton_iterations += increment.report.newton_iterations
            summary.cg_iterations += increment.report.cg_iterations
            summary.residual, summary.note = increment.report.residual, increment.report.note
            summary.stable = increment.stable
            summary.linear_solver = increment.linear_solver
            summary.energies = frame.energies
            summary.largest_displacement = float(np.linalg.norm(frame.displacement, axis=1).max())
            summary.largest_von_mises = float(frame.von_mises.max())
            summary.smallest_jacobian = float(frame.jacobian.min())
            summary.largest_penetration = frame.penetration
            yield frame
        summary.add_forces(reactions(self.model, self.state))


def record_static(run: StaticRun, path: str | Path) -> Generator[Frame, None, None]:
    """Solves and stores each frame in the USD file ``path``, which is overwritten, before it is yielded.

    Nothing is written before the first equilibrium is found. If there is none under the full load, the file holds
    those up to the last.

    Raises:
        OutputError: the file cannot be written.
        SimulationError: as :meth:`StaticRun.frames`.
    """
    frames = run.frames()
    first = [next(frames), next(frames)]
    with scene_writer(path, run.scene, equilibria=True) as writer:
        for frame in chain(first, frames):
            writer.write_frame(body_frames(run.model, frame))
            yield frame


def run_static(
    scene: Scene,
    path: str | Path,
    solver: StaticEquilibrium | None = None,
    *,
    time: float | None = None,
    device: str | None = None,
    dtype: FloatName = "float64",
) -> StaticSummary:
    """Solves a scene's static equilibrium and stores it in the USD file ``path``, which is overwritten if it exists.

    Frame 0 is the start; the others are the equilibria found on the way to the full load, the last one under it.

    Args:
        scene: the scene.
        path: output file, ``.usdc``, ``.usd`` or ``.usda``.
        solver: the settings.
        time: when prescribed motions are held [s]; ``None`` for the time of the last frame.
        device: Warp device, for example "cpu" or "cuda:0"; ``None`` takes Warp's default.
        dtype: "float64", or "float32", whose rounding can hide what is left of the forces.

    Raises:
        SceneError, OutputError, SimulationError: as :class:`StaticRun` and :func:`record_static`.
    """
    run = StaticRun(scene, solver, time=time, device=device, dtype=dtype)
    for _ in record_static(run, path):
        pass
    return run.summary


def _now() -> float:
    return time.perf_counter()


def summary_text(summary: StaticSummary) -> str:
    """A summary for people."""
    steps = len(summary.fractions)
    lines = [
        f"equilibrium at t = {summary.time:.6g} s, in {steps} load step{'s' if steps > 1 else ''}: "
        f"{summary.newton_iterations} Newton and {summary.cg_iterations} conjugate gradient iterations",
        f"residual {summary.residual:.1e} of the largest force" + (f" ({summary.note})" if summary.note else ""),
        f"linear systems: {summary.linear_solver}",
        f"wall time: {summary.setup_seconds:.2f} s to prepare, {summary.solving_seconds:.2f} s to solve",
    ]
    energies = summary.energies
    if energies is not None:
        contact = f", contact {energies.contact:.4g}" if summary.obstacles else ""
        lines.append(f"energy [J]: elastic {energies.elastic:.4g}, load {energies.load:.4g}{contact}")
    lines.append(
        f"largest displacement {summary.largest_displacement:.4g} m, largest von Mises stress "
        f"{summary.largest_von_mises:.4g} Pa, smallest J {summary.smallest_jacobian:.4g}"
    )
    if summary.obstacles:
        lines.append(f"deepest penetration of an obstacle {summary.largest_penetration:.3g} m")
    if summary.loads is not None and summary.unbalanced is not None:
        parts = [*summary.supports, *summary.obstacles, summary.loads, summary.unbalanced]
        width = max(len(part.name) for part in parts)
        lines.append("forces on the bodies [N], and their moments about the origin [N m]:")
        lines += [f"  {part.name:{width}}  {_vector(part.force)}  {_vector(part.moment)}" for part in parts]
    return "\n".join(lines)


def _vector(components: tuple[float, ...]) -> str:
    return f"({', '.join(f'{component:11.4g}' for component in components)})"
