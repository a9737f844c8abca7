"""Cases 6 to 9: inverted, mirrored, collapsed, scrambled and squashed bodies must come back to their rest shape."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np

from warpfem.dtypes import FloatName
from warpfem.errors import SimulationError
from warpfem.extremes.subjects import DTYPES, frugal, hookean, label
from warpfem.extremes.table import Trial, at_most, case
from warpfem.materials import HookeanMaterial, LinearElasticity, Material
from warpfem.mesh import Mesh
from warpfem.scene import Body, Scene
from warpfem.simulation import Simulation
from warpfem.solvers import BackwardEuler

E, NU = 1e5, 0.3
LIMIT = 1e-4
"""Largest distance from the rest shape, in body lengths."""
STEPS = 60
"""After so many steps a body that still changes its shape counts as moving."""


def block(dim: int, quick: bool) -> Mesh:
    """A square or cube of 1 m."""
    cells = 2 if quick else 4 if dim == 2 else 3
    return Mesh.rectangle((1.0, 1.0), (cells, cells)) if dim == 2 else Mesh.box((1.0,) * 3, (cells,) * 3)


def released(setting: str, mesh: Mesh, material: Material, dtype: FloatName, points: np.ndarray) -> Trial:
    """Lets a body go from ``points``, unloaded, in long steps of backward Euler, until it is at rest.

    It passes if it comes back to its rest shape; it is refused if warpfem stops it with a message that names a cell,
    or if it rests elsewhere and warpfem warned that it might; else it has failed.
    """
    body = Body("block", mesh, material, displacement=points - mesh.points)
    scene = Scene([body], BackwardEuler(), dt=1.0, fps=1.0, frames=STEPS)
    linear = isinstance(material, LinearElasticity)
    steps = unconverged = 0
    change, before = np.inf, points - mesh.points
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            simulation = Simulation(scene, device="cpu", dtype=dtype)
            for frame in simulation.frames():
                if frame.index == 0:
                    continue
                steps, unconverged = frame.index, simulation.summary.unconverged_steps
                change = misfit(mesh.points + before, frame.displacement - before, linear)
                before = frame.displacement
                if change < 0.1 * LIMIT:
                    break
        except SimulationError as error:
            return _judged_refusal(setting, str(error))
    distance = misfit(mesh.points, frame.displacement, linear)
    trial = at_most(f"{setting}: {steps} steps, {unconverged} not converged", distance, LIMIT, " L")
    if trial.status == "pass":
        return trial
    inverted = int((frame.jacobian <= 0.0).sum())
    where = (
        f"{'at rest' if change < 0.1 * LIMIT else f'still changing by {change:.1e} L a step'}, {inverted} of "
        f"{mesh.cell_count} cells inverted, energy {frame.energies.elastic:.2g} J"
    )
    messages = [str(w.message) for w in warned if "inverted" in str(w.message)]
    if messages and change < 0.1 * LIMIT:
        return Trial(trial.setting, "refused", f"{distance:.2g} L, {where}", messages[0])
    return Trial(trial.setting, "FAIL", trial.measured, f"{where}{'' if messages else ', no warning'}", trial.ratio)


def _judged_refusal(setting: str, message: str) -> Trial:
    clear = "cell" in message and "J =" in message
    return Trial(setting, "refused" if clear else "FAIL", "", message if clear else f"names no cell: {message}")


def misfit(points: np.ndarray, displacement: np.ndarray, linear: bool) -> float:
    """The largest distance of a displaced point from where the rigid motion that fits best takes it [m].

    Args:
        points: (n, dim) [m].
        displacement: (n, dim) [m].
        linear: whether to fit u = a + W X with a skew W, the rigid motions of linear elasticity.
    """
    X, u = points - points.mean(axis=0), displacement - displacement.mean(axis=0)
    if linear:
        d = X.shape[1]
        pairs = [(i, j) for i in range(d) for j in range(i)]
        spins = np.zeros((len(pairs), d, d))
        for k, (i, j) in enumerate(pairs):
            spins[k, i, j], spins[k, j, i] = 1.0, -1.0
        modes = np.einsum("kij,nj->kni", spins, X).reshape(len(pairs), -1)
        fitted = (np.linalg.lstsq(modes.T, u.ravel(), rcond=None)[0] @ modes).reshape(u.shape)
        return float(np.linalg.norm(u - fitted, axis=1).max())
    x = X + u
    U, _, Vt = np.linalg.svd(x.T @ X)
    U[:, -1] *= np.sign(np.linalg.det(U @ Vt))
    return float(np.linalg.norm(x - X @ (U @ Vt).T, axis=1).max())


def jacobians(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """J of every cell."""
    corners = points[mesh.cells]
    spans = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    return np.linalg.det(spans @ mesh.inverse_shape_matrices)


def subjects(quick: bool, *poisson: float) -> Iterator[tuple[int, HookeanMaterial, FloatName]]:
    """The dimensions, materials and precisions that bodies are let go with."""
    for dim in (2, 3):
        for nu in poisson[:1] if quick else poisson:
            for material in [frugal(dim, E, nu)] if quick else hookean(E, nu):
                for dtype in DTYPES[dim - 2 : dim - 1] if quick else DTYPES:
                    yield dim, material, dtype


RECOVERS = (
    "Let go without loads, by steps of 1 s of backward Euler at E = 1e5 Pa (a wave crosses the body in 0.1 s), the "
    "body comes to rest within 1e-4 of its length from its rest shape, moved rigidly (linear elasticity: by its own "
    "rigid motions, with infinitesimal rotations), or the run is refused by an error that names a cell and its J"
)
WARNED = (
    ", or it rests in another shape and warpfem warned of inverted cells (counted as refused; the table says how far "
    "from its rest shape it rests, and with what energy)."
)


@case(6, "inverted cells, mirrored body", RECOVERS + WARNED)
def inverted(quick: bool) -> Iterator[Trial]:
    for dim, material, dtype in subjects(quick, NU):
        mesh = block(dim, quick)
        x = mesh.points
        rng = np.random.default_rng(6)
        yield released(label(material, dim, dtype, "one cell"), mesh, material, dtype, with_one_inverted(mesh))
        size = 0.1
        while np.mean(jacobians(mesh, half := x + size * rng.normal(size=x.shape)) < 0.0) < 0.45:
            size *= 1.1
        yield released(label(material, dim, dtype, "half of the cells"), mesh, material, dtype, half)
        mirrored = x * np.array([-1.0, 1.0, 1.0])[:dim]
        yield released(label(material, dim, dtype, "mirrored body"), mesh, material, dtype, mirrored)


def with_one_inverted(mesh: Mesh) -> np.ndarray:
    """The rest points with a corner of the body pushed through the opposite face of its only cell, or nearly so."""
    uses = np.bincount(mesh.cells.ravel())
    lone = int(np.argmin(uses))
    cell = mesh.cells[np.flatnonzero((mesh.cells == lone).any(axis=1))[0]]
    opposite = mesh.points[cell[cell != lone]].mean(axis=0)
    points = mesh.points.copy()
    points[lone] += 1.5 * (opposite - points[lone])
    return points


@case(7, "all points in a plane, on a line, in one point (perturbed by 1e-3)", RECOVERS + WARNED)
def collapsed(quick: bool) -> Iterator[Trial]:
    for dim, material, dtype in subjects(quick, NU):
        mesh = block(dim, quick)
        rng = np.random.default_rng(7)
        kept = {"a plane": (1.0, 1.0, 0.0), "a line": (1.0, 0.0, 0.0), "one point": (0.0, 0.0, 0.0)}
        for name, factors in list(kept.items())[3 - dim :]:
            points = mesh.points * np.array(factors)[:dim] + 1e-3 * rng.uniform(-1.0, 1.0, mesh.points.shape)
            yield released(label(material, dim, dtype, f"in {name}"), mesh, material, dtype, points)


@case(8, "points scrambled at random in the box", RECOVERS + WARNED)
def scrambled(quick: bool) -> Iterator[Trial]:
    for dim, material, dtype in subjects(quick, 0.3, 0.45, 0.495):
        mesh = block(dim, quick)
        points = np.random.default_rng(8).uniform(0.0, 1.0, mesh.points.shape)
        yield released(label(material, dim, dtype, f"nu = {material.nu:g}"), mesh, material, dtype, points)


@case(9, "uniform squash to 0.5 and 0.1", RECOVERS + WARNED)
def squashed(quick: bool) -> Iterator[Trial]:
    for dim, material, dtype in subjects(quick, 0.3, 0.0, 0.45):
        mesh = block(dim, quick)
        for factor in (0.5, 0.1):
            setting = label(material, dim, dtype, f"nu = {material.nu:g}", f"to {factor:g}")
            yield released(setting, mesh, material, dtype, factor * mesh.points)
