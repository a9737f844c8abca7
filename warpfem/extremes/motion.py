"""Small scenes in motion: what the cases that step through time share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeAlias

import numpy as np

from warpfem.dtypes import FloatName
from warpfem.errors import WarpfemError
from warpfem.extremes.subjects import DTYPES
from warpfem.extremes.table import Trial
from warpfem.materials import MATERIALS, HookeanMaterial, LinearElasticity, StableNeoHookean
from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.scene import Body, Scene
from warpfem.simulation import Simulation
from warpfem.solvers import BackwardEuler, Solver, SymplecticEuler, VelocityVerlet

Material: TypeAlias = type[HookeanMaterial]

EXPLICIT = (SymplecticEuler(), VelocityVerlet())
IMPLICIT = (BackwardEuler(), BackwardEuler.linearised())
NEWTON, LINEARISED = IMPLICIT
VERLET = EXPLICIT[1]


@dataclass(frozen=True)
class Setting:
    """A material, a dimension and a precision."""

    material: Material
    dim: int
    dtype: FloatName

    def __str__(self) -> str:
        return f"{self.material.__name__}, {self.dim}D, {self.dtype}"

    def vector(self, *components: float) -> tuple[float, ...]:
        """The first ``dim`` components, filled up with zeros."""
        return (*components, 0.0, 0.0, 0.0)[: self.dim]

    def brick(self, size: Sequence[float], cells: Sequence[int], origin: Sequence[float] = (0.0, 0.0, 0.0)) -> Mesh:
        """A rectangle or a box, of the first ``dim`` entries of each."""
        builder = Mesh.rectangle if self.dim == 2 else Mesh.box
        return builder(size[: self.dim], cells[: self.dim], origin[: self.dim])

    def simulation(
        self, bodies: list[Body], solver: Solver, dt: float, frames: int, steps_per_frame: int = 1, **scene: Any
    ) -> Simulation:
        """A simulation on the CPU with steps of ``dt`` [s], as many to a frame as given."""
        fps = 1.0 / (steps_per_frame * dt)
        return Simulation(Scene(bodies, solver, dt=dt, fps=fps, frames=frames, **scene), device="cpu", dtype=self.dtype)


def settings(quick: bool, without: Sequence[Material] = ()) -> Iterator[Setting]:
    """The settings of a case: two when quick, else all materials, dimensions and precisions."""
    if quick:
        frugal = (Setting(StableNeoHookean, 3, "float32"), Setting(LinearElasticity, 2, "float64"))
        yield from (setting for setting in frugal if setting.material not in without)
        return
    materials = [material for material in MATERIALS.values() if material not in without]
    for material, dim, dtype in product(materials, (2, 3), DTYPES):
        yield Setting(material, dim, dtype)


def solver_name(solver: Solver) -> str:
    """What a solver is called in the table."""
    return "linearised backward Euler" if solver == LINEARISED else type(solver).__name__


def attempt(trial: Callable[..., Trial], setting: str, *arguments: Any, may_refuse: bool = False) -> Trial:
    """``trial(setting, *arguments)``; if warpfem refuses instead, that is what the trial says."""
    try:
        return trial(setting, *arguments)
    except WarpfemError as error:
        return Trial(setting, "refused" if may_refuse else "FAIL", "", str(error))


def unless_reported(trial: Trial, solver: Solver, simulation: Simulation) -> Trial:
    """The trial; one that failed by single linear solves counts as refused if its steps were reported as unsolved."""
    summary = simulation.summary
    if trial.status == "FAIL" and solver == LINEARISED and summary.unconverged_steps:
        reported = f"{summary.unconverged_steps} of {summary.steps} steps not converged: {summary.worst_note}"
        return replace(trial, status="refused", note=reported)
    return trial


def stable_dt(setting: Setting, body: Body, solver: Solver) -> float:
    """The stability limit of explicit steps for a body that nothing acts on, as it starts [s]."""
    model = Model(Scene([body], solver), device="cpu", dtype=setting.dtype)
    limit = solver.stepper(model).stable_dt(model.state())
    assert limit is not None
    return limit


def natural_growth(solver: Solver, fraction: float) -> float:
    """How often an explicit scheme can have its energy of the start at ``fraction`` of its limit, without growth.

    It conserves another energy. In a mode of angular frequency w, with c = w dt / 2, that is (v^2 + (1 - c^2) w^2 u^2)
    / 2 for Verlet and (v^2 + w^2 u^2 - 2 c w u v) / 2 for symplectic Euler; the fastest mode has c = ``fraction``.
    """
    if solver == VERLET:
        return 1.0 / (1.0 - fraction**2)
    return (1.0 + fraction) / (1.0 - fraction)


def momentum(mass: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Linear momentum [kg m/s]."""
    return mass @ velocity


def angular_momentum(mass: np.ndarray, points: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Angular momentum about the centre of mass [kg m^2/s], (1,) in the plane, (3,) in space."""
    centre, drift = mass @ points / mass.sum(), mass @ velocity / mass.sum()
    return np.atleast_1d(mass @ np.cross(points - centre, velocity - drift))
