"""Cases 1 to 5 and 22: forces, stresses and trajectories where rounding could spoil them."""

from __future__ import annotations

import itertools
import math
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import warp as wp

from warpfem.boundary import Pin, Plane, Sphere
from warpfem.dtypes import FloatName
from warpfem.extremes.subjects import (
    DTYPES,
    EPSILON,
    custom,
    frugal,
    hookean,
    label,
    model_of,
    rotation,
    simplices,
    slab,
)
from warpfem.extremes.table import Trial, at_most, case
from warpfem.materials import HookeanMaterial, LinearElasticity, Material
from warpfem.mesh import Mesh
from warpfem.model import State
from warpfem.moduli import elastic_moduli
from warpfem.scene import Body, Scene
from warpfem.simulation import Simulation
from warpfem.solvers import BackwardEuler, Solver, SymplecticEuler, VelocityVerlet

E, NU = 1e5, 0.3


@case(
    1,
    "rigid rotation 0..360 degrees, translation",
    "After a rigid rotation by 0 to 360 degrees the largest force at a point is below 4 eps E A L/h: eps the "
    "precision, A the cross-section, L the body's length, h its shortest edge. A translation by T = 1e6 L gives no "
    "force at all, and changes the forces of a deformed body by at most 4 eps E A |T|/h, which is what the "
    "displacement resolves. All at nu = 0.3: what one rounding of the displacement makes grows with lambda/E. (Linear "
    "elasticity is not invariant under rotations: translation only.)",
)
def rigid_motion(quick: bool) -> Iterator[Trial]:
    rng = np.random.default_rng(1)
    for dim in (2, 3):
        mesh = slab(dim)
        x, length, edge = mesh.points, 2.0, mesh.edge_lengths.min()
        axes = [np.ones(2)] if dim == 2 else [*np.eye(3), np.ones(3), *rng.normal(size=(0 if quick else 3, 3))]
        angles = np.radians(np.arange(0.0, 361.0, 45.0 if quick else 7.5))
        noise = 0.05 * edge * rng.uniform(-1.0, 1.0, x.shape)
        materials = hookean(E, NU) if quick else [*hookean(E, NU), custom(E, NU)]
        for material in materials:
            for dtype in DTYPES:
                model = model_of(material, mesh, dtype)
                limit = 4.0 * EPSILON[dtype] * E / edge  # A = 1 m^2
                state = model.state()

                def forces(u: np.ndarray, model=model, state=state) -> np.ndarray:
                    state.assign(displacement=u)
                    return model.internal_force(state)

                if not isinstance(material, LinearElasticity):
                    turned = [x @ rotation(axis, angle).T - x for axis in axes for angle in angles]
                    worst = max(np.linalg.norm(forces(u), axis=1).max() for u in turned)
                    yield at_most(label(material, dim, dtype, f"{len(turned)} rotations"), worst, limit * length, " N")
                shift = np.full(dim, 1e6 * length / np.sqrt(dim))
                worst = np.abs(forces(np.broadcast_to(shift, x.shape))).max()
                yield at_most(label(material, dim, dtype, "translated by 1e6 L"), worst, 0.0, " N")
                change = forces(noise + shift) - forces(noise)
                worst = np.linalg.norm(change, axis=1).max()
                yield at_most(label(material, dim, dtype, "deformed and translated"), worst, limit * 1e6 * length, " N")


@case(
    2,
    "strain of 1e-7",
    "Of cells with random displacement gradients H of size 1e-7, the stress P, the forces on the points and the energy "
    "density in float32 differ from those in float64 of the same H by less than 1e-5 of their size; those in float64 "
    "from Hooke's law, evaluated in NumPy, by less than 1e-5 of (lam + 2 mu) |H|. (The energy of a user's own psi(F) "
    "is not compared: psi near F = I cancels by itself. Its stress is.)",
)
def small_strain(quick: bool) -> Iterator[Trial]:
    rng = np.random.default_rng(2)
    for dim in (2, 3):
        mesh = slab(dim)
        noise = 1e-7 * mesh.edge_lengths.min() * rng.normal(size=mesh.points.shape)
        for nu in (NU,) if quick else (0.0, NU, 0.45, 0.495):
            moduli = elastic_moduli(E=E, nu=nu)
            for material in hookean(E, nu) if quick else [*hookean(E, nu), custom(E, nu)]:
                single, double = (model_of(material, mesh, dtype) for dtype in DTYPES)
                state, same = single.state(), double.state()
                state.assign(displacement=noise)
                same.assign(displacement=state.displacement)
                errors = {
                    "P": relative_error(
                        single.stresses(state).first_piola_kirchhoff, double.stresses(same).first_piola_kirchhoff
                    ),
                    "force": relative_error(single.internal_force(state), double.internal_force(same)),
                }
                H = displacement_gradients(mesh, same.displacement)
                P = moduli.mu * (H + H.transpose(0, 2, 1))
                P += moduli.lam * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(3)
                difference = np.linalg.norm(double.stresses(same).first_piola_kirchhoff - P, axis=(1, 2))
                hooke = {"P": np.max(difference / (moduli.p_wave * np.linalg.norm(H, axis=(1, 2))))}
                if isinstance(material, HookeanMaterial):
                    energy = double.energy_densities(same)
                    errors["energy"] = relative_error(single.energy_densities(state), energy)
                    difference = np.abs(energy - 0.5 * np.einsum("cij,cij->c", P, H))
                    hooke["energy"] = np.max(difference / (moduli.p_wave * np.sum(H * H, axis=(1, 2))))
                for name, error in errors.items():
                    yield at_most(label(material, dim, f"nu = {nu:g}", name, "float32"), error, 1e-5)
                for name, error in hooke.items():
                    yield at_most(label(material, dim, f"nu = {nu:g}", name, "float64, Hooke"), error, 1e-5)


def displacement_gradients(mesh: Mesh, displacement: np.ndarray) -> np.ndarray:
    """H of every cell, (cell_count, 3, 3)."""
    corners = displacement[mesh.cells]
    H = np.zeros((mesh.cell_count, 3, 3))
    d = mesh.dim
    H[:, :d, :d] = np.einsum("cki,ckj->cij", corners[:, 1:] - corners[:, :1], mesh.inverse_shape_matrices)
    return H


def relative_error(actual: np.ndarray, expected: np.ndarray) -> float:
    """The largest |actual - expected| over |expected| of any entry of the first axis."""
    axes = tuple(range(1, expected.ndim))
    difference, size = np.sum((actual - expected) ** 2, axis=axes), np.sum(expected**2, axis=axes)
    return float(np.sqrt(np.max(difference / size)))


@case(
    5,
    "stretches 1e-3 to 1e3 and shear 1e3",
    "Energy density, stress, force and force differential are finite at F with singular values of 1e-3, 1 and 1e3 and "
    "at a simple shear of 1e3, along the axes and rotated. (Not if F has stretches of both 1e-3 and 1e3 and is rotated "
    "in float32, which does not resolve it, or the material is a user's psi(F): its differential is a difference over "
    "6e-6 |F|.) In float64 central differences of the energy converge to the stress, and those of "
    "the stress to the differential, at order 2 (1.9 to 2.1 where the error is above 300 times rounding) and to within "
    "1e-6, or 100 times rounding if that is more.",
)
def large_deformation(quick: bool) -> Iterator[Trial]:
    rng = np.random.default_rng(5)
    for dim in (2, 3):
        straight, rotated = large_gradients(dim, rng)
        even = np.linalg.cond(straight) < 1e5
        direction = rng.normal(size=(len(straight), dim, dim))
        for material in hookean(E, NU) if quick else [*hookean(E, NU), *hookean(E, 0.495), custom(E, NU)]:
            hooke = isinstance(material, HookeanMaterial)
            for dtype in DTYPES:
                for kind, F in (("axes", straight), ("rotated", rotated)):
                    cells = FreeCells(material, F, dtype)
                    finite = np.ones(len(F), bool)
                    for value in (
                        cells.energy_density(F),
                        cells.stress(F),
                        cells.solid_stress(F),
                        cells.stress_differential(F, direction),
                    ):
                        finite &= np.isfinite(value).reshape(len(F), -1).all(axis=1)
                    concerned = even | (hooke and (kind == "axes" or dtype == "float64"))
                    bad = np.flatnonzero(concerned & ~finite)
                    trial = at_most(label(_with_nu(material), dim, dtype, kind), len(bad), 0.0, " F not finite")
                    yield replace(trial, note="; ".join(f"stretches {np.linalg.svd(F[i])[1]}" for i in bad))
            cells = FreeCells(material, straight, "float64")
            trials = list(_orders(label(_with_nu(material), dim, "float64"), cells, straight, direction))
            yield from trials if hooke else trials[:1]


def large_gradients(dim: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Deformation gradients (n, dim, dim) of extreme stretch and shear: along the axes, and the same rotated."""
    stretches = list(itertools.combinations_with_replacement((1e-3, 1.0, 1e3), dim))
    shear = np.eye(dim)
    shear[0, 1] = 1e3
    straight = np.stack([*(np.diag(s) for s in stretches), shear])
    turn = [[rotation(rng.normal(size=dim), angle) for angle in rng.uniform(0.0, 6.3, len(straight))] for _ in range(2)]
    return straight, np.stack(turn[0]) @ straight @ np.stack(turn[1])


class FreeCells:
    """A material evaluated at deformation gradients (n, dim, dim), one for each of n unit simplices."""

    def __init__(self, material: Material, F: np.ndarray, dtype: FloatName) -> None:
        self.dim = F.shape[-1]
        self.model = model_of(material, simplices(self.dim, len(F)), dtype)
        self.volume = 1.0 / math.factorial(self.dim)

    def _points(self, A: np.ndarray) -> np.ndarray:
        """The vectors at the points, (n (dim + 1), dim), that have the gradients A."""
        vectors = np.zeros((len(A), self.dim + 1, self.dim))
        vectors[:, 1:] = A.transpose(0, 2, 1)  # the k-th corner moves by A e_k
        return vectors.reshape(-1, self.dim)

    def _gradients(self, force: np.ndarray) -> np.ndarray:
        return -force.reshape(-1, self.dim + 1, self.dim)[:, 1:].transpose(0, 2, 1) / self.volume

    def _state(self, F: np.ndarray) -> State:
        state = self.model.state()
        state.assign(displacement=self._points(F - np.eye(self.dim)))
        return state

    def energy_density(self, F: np.ndarray) -> np.ndarray:
        """psi (n,)."""
        return self.model.energy_densities(self._state(F))

    def stress(self, F: np.ndarray) -> np.ndarray:
        """P (n, dim, dim), from the forces on the points."""
        return self._gradients(self.model.internal_force(self._state(F)))

    def solid_stress(self, F: np.ndarray) -> np.ndarray:
        """P (n, 3, 3), with its part out of the plane."""
        return self.model.stresses(self._state(F)).first_piola_kirchhoff

    def stress_differential(self, F: np.ndarray, dF: np.ndarray) -> np.ndarray:
        """dP (n, dim, dim) for the change dF."""
        return self._gradients(self.model.force_differential(self._state(F), self._points(dF)))


def _orders(name: str, cells: FreeCells, F: np.ndarray, direction: np.ndarray) -> Iterator[Trial]:
    """The orders at which central differences about F converge, along directions in proportion to the stretches."""
    U, s, Vt = np.linalg.svd(F)
    dF = U @ (direction * np.minimum(s[:, :, None], s[:, None, :])) @ Vt
    P, dP = cells.stress(F), cells.stress_differential(F, dF)
    slope = np.einsum("nij,nij->n", P, dF)
    curvature = np.abs(np.einsum("nij,nij->n", dP, dF))  # where the slope is zero it measures the energy's change
    d = F.shape[-1]
    units = np.eye(d * d).reshape(-1, 1, d, d)
    stiffness = np.sqrt(
        sum(_norms(cells.stress_differential(F, np.broadcast_to(unit, F.shape))) ** 2 for unit in units)
    )
    H = _norms(F - np.eye(d)) + 1.0  # is rounded, and with it what is computed from it
    for what, function, exact, size, rate in (
        ("energy to stress", cells.energy_density, slope, np.abs(slope) + curvature, _norms(P) + E),
        ("stress to differential", cells.stress, dP, _norms(dP), stiffness),
    ):
        value = _norms(function(F)) + rate * H
        errors, rounding = [], []
        for step in 0.02 * 0.5 ** np.arange(14):
            difference = (function(F + step * dF) - function(F - step * dF)) / (2.0 * step)
            errors.append(_norms(difference - exact) / size)
            rounding.append(EPSILON["float64"] * value / step / size)
        error, noise = np.array(errors), np.array(rounding)  # (steps, n)
        best, floor = error.min(axis=0), np.maximum(1e-6, 100.0 * noise.min(axis=0))
        clear = error > 300.0 * noise
        orders = [
            np.log2(error[last - 1, i] / error[last, i])
            for i in range(len(F))
            if (last := np.flatnonzero(clear[:, i]).max(initial=0)) > 0
        ]
        figure = f"orders {min(orders):.3f} to {max(orders):.3f}" if orders else "exact"
        passed = (best <= floor).all() and all(1.9 <= order <= 2.1 for order in orders)
        worst = (best / floor).max()
        yield Trial(f"{name}, {what}", "pass" if passed else "FAIL", f"{figure}, {worst:.1e} of the limit", ratio=worst)


def _norms(values: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum(values.reshape(len(values), -1) ** 2, axis=1))


def _with_nu(material: Material) -> str:
    return f"{type(material).__name__}" + (f", nu = {material.nu:g}" if isinstance(material, HookeanMaterial) else "")


# ---- trajectories


def thrown(
    mesh: Mesh,
    material: Material,
    solver: Solver,
    *,
    quick: bool,
    length: float = 1.0,
    stiffness: float = E,
    density: float = 1e3,
) -> Scene:
    """A slab, pinned on the left, that swings onto a floor and a ball, both rough, and back.

    Args:
        mesh: a :func:`slab`, perhaps moved, times ``length``.
        material: of Young's modulus ``stiffness``.
        solver: the solver.
        quick: whether to end at the first impact, before it swings back.
        length: the unit of length [m]. Speed, gravity and time follow from it and from the speed of waves.
        stiffness: [Pa].
        density: [kg/m^3].
    """
    speed = np.sqrt(stiffness / density)
    right, up = np.eye(mesh.dim)[:2]
    corner = mesh.bounding_box[0]
    below = corner + length * np.array([2.0, -0.28125, 0.5])[: mesh.dim]  # of binary fractions: exact also far away

    def velocity(x: np.ndarray) -> np.ndarray:
        return -0.1 * speed * np.outer((x - corner) @ right / length, up)

    return Scene(
        [Body("slab", mesh, material, density, supports=[Pin("left")], velocity=velocity)],
        solver,
        dt=(0.05 if isinstance(solver, BackwardEuler) else 0.01) * length / speed,
        gravity=-0.01 * speed**2 / length * up,
        obstacles=[
            Plane(corner - 0.0625 * length * up, up, friction=0.5),
            Sphere(below, 0.25 * length, friction=0.5),
        ],
        damping=0.1 * speed / length,
        fps=2.0 * speed / length,
        frames=3 if quick else 8,
    )


def trajectory(scene: Scene, dtype: FloatName) -> np.ndarray:
    """The displacements of all frames, (frames, point_count, dim) [m]."""
    return np.stack([frame.displacement for frame in Simulation(scene, device="cpu", dtype=dtype).frames()])


def settings(quick: bool) -> Iterator[tuple[int, HookeanMaterial, Solver, FloatName]]:
    """What trajectories are run with."""
    implicit, explicit = BackwardEuler(), VelocityVerlet()
    if quick:
        for dim in (2, 3):
            yield dim, frugal(dim, E, NU), implicit, "float64" if dim == 2 else "float32"
            yield dim, frugal(dim, E, NU), explicit, "float32" if dim == 2 else "float64"
        return
    for dim in (2, 3):
        for dtype in DTYPES:
            for material in hookean(E, NU):
                yield dim, material, implicit, dtype
                yield dim, material, explicit, dtype
            yield dim, frugal(dim, E, NU), BackwardEuler.linearised(), dtype
            yield dim, frugal(dim, E, NU), SymplecticEuler(), dtype


def solver_name(solver: Solver) -> str:
    """How trials call a solver."""
    linearised = isinstance(solver, BackwardEuler) and solver.max_iterations == 1
    return f"{type(solver).__name__}{'.linearised' if linearised else ''}"


@case(
    3,
    "rest shape 1e6 lengths from the origin",
    "A body that swings onto a floor and a ball with friction has the same displacements, bit for bit, when the whole "
    "scene is moved by 1e6 body lengths along every axis, if its coordinates are exact there. If they are not, because "
    "the points are irregular, the displacements change by less than 100 times what a point is rounded by.",
)
def far_away(quick: bool) -> Iterator[Trial]:
    far = 2e6  # the slab is 2 m long
    rng = np.random.default_rng(3)
    for dim, material, solver, dtype in settings(quick):
        mesh = slab(dim)
        near = trajectory(thrown(mesh, material, solver, quick=quick), dtype)
        moved = trajectory(thrown(mesh.transformed(offset=(far,) * dim), material, solver, quick=quick), dtype)
        name = label(material, dim, dtype, solver_name(solver))
        yield at_most(f"{name}, exact", np.abs(moved - near).max(), 0.0, " m")
        irregular = Mesh(mesh.points + 0.05 * rng.uniform(-1.0, 1.0, mesh.points.shape), mesh.cells, mesh.point_sets)
        near = trajectory(thrown(irregular, material, solver, quick=quick), dtype)
        moved = trajectory(thrown(irregular.transformed(offset=(far,) * dim), material, solver, quick=quick), dtype)
        rounding = max(EPSILON[dtype], far * EPSILON["float64"])
        yield at_most(f"{name}, irregular", np.abs(moved - near).max(), 100.0 * rounding, " m")


@case(
    4,
    "units from 1e-6 to 1e3 m",
    "A body that swings onto a floor and a ball with friction has the same displacements in body lengths if it is "
    "1e-6, 1e-3 or 1e3 times as large, with time and gravity in proportion, and if the same body is described in units "
    "of 1e-6, 1e-3 or 1e3 m: to 1e-5 L in float32, 1e-9 L in float64.",
)
def units(quick: bool) -> Iterator[Trial]:
    scales = (1e-6,) if quick else (1e-6, 1e-3, 1e3)
    for dim, material, solver, dtype in settings(quick):
        expected = trajectory(thrown(slab(dim), material, solver, quick=quick), dtype)
        limit = {"float32": 1e-5, "float64": 1e-9}[dtype]
        for scale in scales:
            name = label(material, dim, dtype, solver_name(solver))
            scene = thrown(slab(dim).transformed(scale), material, solver, quick=quick, length=scale)
            difference = np.abs(trajectory(scene, dtype) / scale - expected).max()
            yield at_most(f"{name}, {scale:g} times as large", difference, limit, " L")
            other = replace(material, E=E * scale, nu=NU, K=None, lam=None, mu=None)
            scene = thrown(
                slab(dim).transformed(1.0 / scale),
                other,
                solver,
                quick=quick,
                length=1.0 / scale,
                stiffness=E * scale,
                density=1e3 * scale**3,
            )
            difference = np.abs(trajectory(scene, dtype) * scale - expected).max()
            yield at_most(f"{name}, unit {scale:g} m", difference, limit, " L")


@case(
    22,
    "the same run twice",
    "Two runs of the same scene, with contact and friction, give the same bits on the CPU: in one process in the quick "
    "form, in two in the full one.",
)
def same_bits(quick: bool) -> Iterator[Trial]:
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, initializer=_quieten) as other_process:
        for setting in settings(quick):
            first = _run_thrown(quick, *setting)
            second = (
                _run_thrown(quick, *setting) if quick else other_process.submit(_run_thrown, quick, *setting).result()
            )
            dim, material, solver, dtype = setting
            different = float(np.sum(first != second))
            yield at_most(label(material, dim, dtype, solver_name(solver)), different, 0.0, " numbers differ")


def _quieten() -> None:
    """Keeps Warp in another process from printing what it loads."""
    wp.config.log_level = wp.LOG_ERROR


def _run_thrown(quick: bool, dim: int, material: Material, solver: Solver, dtype: FloatName) -> np.ndarray:
    return trajectory(thrown(slab(dim), material, solver, quick=quick), dtype)
