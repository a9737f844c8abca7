"""Cases 10 and 11: material parameters at and beyond the ends of their domain, and far apart in one body."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator
from functools import partial

import numpy as np

from warpfem.boundary import Pin, Traction, Vector
from warpfem.dtypes import FloatName
from warpfem.extremes.subjects import DTYPES, frugal, label, model_of, simplices, two_term_energy
from warpfem.extremes.table import Trial, at_most, attempted, case, refused
from warpfem.materials import MATERIALS, EnergyMaterial, FixedCorotated, HookeanMaterial, NeoHookean, StableNeoHookean
from warpfem.mesh import Mesh
from warpfem.scene import Body, Scene
from warpfem.simulation import Simulation, Summary
from warpfem.solvers import BackwardEuler, VelocityVerlet

E = 1e5
LEGAL_NU = (-0.9, -0.86, -0.84, -0.5, -0.2, 0.0, 0.3, 0.45, 0.495, 0.4999)
NO_NUMBERS = (np.nan, np.inf)
WARNED_BELOW: dict[type[HookeanMaterial], float] = {NeoHookean: 0.0, FixedCorotated: 0.0, StableNeoHookean: -0.85}
REST_STEPS = 8


@case(
    10,
    "parameters accepted, warned of and refused",
    "nu from -0.9 to 0.4999 is accepted by every material, and a body with it comes back from a squash by 1 % in "
    "implicit steps. There is a warning for lambda < 0 of Neo-Hookean and fixed corotated and for nu < -0.85 of stable "
    "Neo-Hookean, and nowhere else; no energy density at stretches from 1e-3 to 1e3 is below that of rest without a "
    "warning. nu <= -1, nu >= 0.5, E <= 0, density <= 0 and any of them not finite is refused by name, also in a "
    "single cell of many.",
)
def domains(quick: bool) -> Iterator[Trial]:
    for kind in MATERIALS.values():
        for nu in LEGAL_NU:
            with warnings.catch_warnings(record=True) as warned:
                warnings.simplefilter("always")
                material = kind(E=E, nu=nu)
            lowest = min(least_energy(material, dim) / E for dim in (2, 3))
            expected = nu < WARNED_BELOW.get(kind, -1.0)
            right = bool(warned) == expected and (expected or lowest > -1e-12)
            measured = f"{'warned' if warned else 'accepted'}, least psi/E {lowest:.2g}"
            note = str(warned[0].message) if warned else ""
            yield Trial(label(material, f"nu = {nu:g}"), "pass" if right else "FAIL", measured, note)
    if not quick:
        for kind, nu, dim, dtype in itertools.product(MATERIALS.values(), LEGAL_NU, (2, 3), DTYPES):
            name = label(kind.__name__, dim, dtype, f"nu = {nu:g}, implicit steps")
            yield attempted(name, partial(squash_a_little, name, kind(E=E, nu=nu), dim, dtype))
    yield from _refusals()


def least_energy(material: HookeanMaterial, dim: int) -> float:
    """The least energy density [Pa] at stretches along the axes from 1e-3 to 1e3, in all combinations."""
    stretches = np.concatenate([np.geomspace(1e-3, 1e3, 25), [0.5, 0.8, 0.9, 1.1, 1.2]])
    every = np.array(list(itertools.combinations_with_replacement(stretches, dim)))
    model = model_of(material, simplices(dim, len(every)), "float64")
    displacement = np.zeros((len(every), dim + 1, dim))
    displacement[:, 1:][:, range(dim), range(dim)] = every - 1.0
    state = model.state()
    state.assign(displacement=displacement.reshape(-1, dim))
    return float(model.energy_densities(state).min())


def squash_a_little(name: str, material: HookeanMaterial, dim: int, dtype: FloatName) -> Trial:
    """Five implicit steps of 1 s from a squash by 1 %."""
    mesh = Mesh.rectangle((1.0, 1.0), (2, 2)) if dim == 2 else Mesh.box((1.0,) * 3, (2,) * 3)
    body = Body("block", mesh, material, displacement=lambda x: -0.01 * (x - 0.5))
    simulation = Simulation(Scene([body], BackwardEuler(), dt=1.0, fps=1.0, frames=5), device="cpu", dtype=dtype)
    *_, last = simulation.frames()
    return at_most(name, np.abs(np.ptp(mesh.points + last.displacement, axis=0) - 1.0).max(), 1e-4, " L")


def _refusals() -> Iterator[Trial]:
    mesh = Mesh.rectangle((1.0, 1.0), (1, 1))
    for kind in MATERIALS.values():
        name = kind.__name__
        for nu in (-1.0, -1.5, 0.5, 0.7, *NO_NUMBERS):
            yield refused(f"{name}, nu = {nu:g}", partial(kind, E=E, nu=nu), name, "nu must be")
        for young in (0.0, -1.0, *NO_NUMBERS):
            yield refused(f"{name}, E = {young:g}", partial(kind, E=young, nu=0.3), name, "E must be")
        cells = np.array([0.3, 0.5])
        yield refused(f"{name}, nu = 0.5 in cell 1", partial(kind, E=E, nu=cells), name, "nu must be", "cell 1")
        cells = np.array([E, 0.0])
        yield refused(f"{name}, E = 0 in cell 1", partial(kind, E=cells, nu=0.3), name, "E must be", "cell 1")
        material = kind(E=E, nu=0.3)
        for density in (0.0, -1.0, *NO_NUMBERS):
            body = partial(Body, "block", mesh, material, density)
            yield refused(f"{name}, density = {density:g}", body, "body 'block'", "density must be")
        body = partial(Body, "block", mesh, material, np.array([1e3, -1.0]))
        yield refused(f"{name}, density = -1 in cell 1", body, "body 'block'", "density must be", "cell 1")
    user = partial(EnergyMaterial, two_term_energy, {"mu": np.nan, "lam": 1.0})
    yield refused("EnergyMaterial, a parameter that is nan", user, "EnergyMaterial", "'mu'", "finite")


@case(
    11,
    "stiffness contrast 1e6 and 1e9 in one body",
    "Of a body of two halves, one 1e6 or 1e9 times as stiff, every step of backward Euler converges and the soft half "
    "comes to rest where it does on a rigid half, to 1e-3 of the largest displacement: with the hard half pinned and "
    "the soft one bent by gravity, and with the soft half pinned and stretched by the hard one; or the run says how "
    "many steps did not converge and by how much (counted as refused). Velocity Verlet at dt="
    '"auto" keeps the energy of the start to 1 % at a contrast of 1e6.',
)
def contrast(quick: bool) -> Iterator[Trial]:
    for dim, dtype in zip((2, 3), DTYPES, strict=True) if quick else itertools.product((2, 3), DTYPES):
        for kind in [type(frugal(dim, E, 0.3))] if quick else list(MATERIALS.values()):
            for ratio in (1e6, 1e9):
                name = label(kind.__name__, dim, dtype, f"{ratio:g}")
                yield from _implicit(name, kind, dim, dtype, ratio)
            yield _explicit(label(kind.__name__, dim, dtype, "1e+06, explicit"), kind, dim, dtype)


def _implicit(name: str, kind: type[HookeanMaterial], dim: int, dtype: FloatName, ratio: float) -> Iterator[Trial]:
    gravity = tuple(-np.eye(dim)[1])
    pinned, free = hard_half_pinned(kind, dim, ratio), hard_half_free(kind, dim, ratio)
    yield attempted(f"{name}, hard half pinned", lambda: _agree(f"{name}, hard half pinned", *pinned, gravity, dtype))
    yield attempted(f"{name}, hard half free", lambda: _agree(f"{name}, hard half free", *free, None, dtype))


def halves(kind: type[HookeanMaterial], dim: int, ratio: float) -> tuple[Mesh, HookeanMaterial, Mesh]:
    """A body of 2 m x 1 m (x 1 m), its material with a hard half at x < 1 m, and the soft half's mesh alone."""
    mesh = Mesh.rectangle((2.0, 1.0), (4, 2)) if dim == 2 else Mesh.box((2.0, 1.0, 1.0), (4, 2, 2))
    hard = mesh.points[mesh.cells].mean(axis=1)[:, 0] < 1.0
    soft = Mesh.repaired(mesh.points, mesh.cells[~hard])
    soft = soft.with_point_set("interface", lambda x: x[:, 0] == 1.0).with_point_set("right", lambda x: x[:, 0] == 2.0)
    return mesh, kind(E=np.where(hard, ratio * E, E), nu=0.3), soft


def hard_half_pinned(kind: type[HookeanMaterial], dim: int, ratio: float) -> tuple[Body, Body]:
    """The soft half bends under its weight, on the hard one and on a rigid one."""
    mesh, material, soft = halves(kind, dim, ratio)
    return (
        Body("both", mesh, material, supports=[Pin("left")]),
        Body("alone", soft, kind(E=E, nu=0.3), supports=[Pin("interface")]),
    )


def hard_half_free(kind: type[HookeanMaterial], dim: int, ratio: float) -> tuple[Body, Body]:
    """The soft half is held and stretched, without getting thinner, by the hard one and by a rigid one."""
    mesh, material, soft = halves(kind, dim, ratio)

    def stretched(name: str, mesh: Mesh, material: HookeanMaterial, end: str) -> Body:
        sides = Pin(np.arange(mesh.point_count), axes=tuple(range(1, dim)))
        pull = Traction(end, -0.05 * E * np.eye(dim)[0])
        return Body(name, mesh, material, supports=[sides, Pin("right", axes=(0,))], loads=[pull])

    return stretched("both", mesh, material, "left"), stretched("alone", soft, kind(E=E, nu=0.3), "interface")


def at_rest(body: Body, gravity: Vector | None, dtype: FloatName) -> tuple[np.ndarray, Summary]:
    """The displacement (point_count, dim) [m] after some long implicit steps, and the summary of the run."""
    scene = Scene([body], BackwardEuler(), dt=1.0, fps=1.0, frames=REST_STEPS, gravity=gravity)
    simulation = Simulation(scene, device="cpu", dtype=dtype)
    *_, last = simulation.frames()
    return last.displacement, simulation.summary


def _agree(name: str, both: Body, alone: Body, gravity: Vector | None, dtype: FloatName) -> Trial:
    displacement, summary = at_rest(both, gravity, dtype)
    expected, _ = at_rest(alone, gravity, "float64")
    difference = np.abs(displacement[both.mesh.points[:, 0] >= 1.0] - expected).max()
    trial = at_most(name, difference / np.abs(expected).max(), 1e-3)
    if not summary.unconverged_steps:
        return trial
    note = (
        f"{summary.unconverged_steps} of {REST_STEPS} steps not converged: residual {summary.worst_residual:.1e}, "
        f"{summary.worst_note}"
    )
    return Trial(name, "refused", trial.measured, note, trial.ratio)


def _explicit(name: str, kind: type[HookeanMaterial], dim: int, dtype: FloatName) -> Trial:
    mesh, material, _ = halves(kind, dim, 1e6)

    def velocity(x: np.ndarray) -> np.ndarray:
        return np.maximum(x[:, :1] - 1.0, 0.0) * np.eye(dim)[1]  # the soft half swings

    scene = Scene([Body("both", mesh, material, velocity=velocity)], VelocityVerlet(), fps=500.0, frames=4)

    def drift() -> Trial:
        energies = [frame.energies.total for frame in Simulation(scene, device="cpu", dtype=dtype).frames()]
        return at_most(name, np.ptp(energies) / energies[0], 0.01)

    return attempted(name, drift)
