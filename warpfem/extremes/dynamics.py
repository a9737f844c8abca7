"""Cases on motion: contrasts of mass, time steps, long flights, fast spin, great forces, hard impacts."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from itertools import product

import numpy as np

from warpfem.boundary import Obstacle, Pin, Plane, Sphere, Traction
from warpfem.errors import SimulationError, TimeStepError, WarpfemError
from warpfem.extremes.motion import (
    EXPLICIT,
    IMPLICIT,
    LINEARISED,
    NEWTON,
    VERLET,
    Setting,
    angular_momentum,
    attempt,
    momentum,
    natural_growth,
    settings,
    solver_name,
    stable_dt,
    unless_reported,
)
from warpfem.extremes.table import Trial, at_most, case
from warpfem.materials import LinearElasticity
from warpfem.model import Energies
from warpfem.scene import Body, Scene
from warpfem.simulation import AUTO_FRACTION, Frame, Simulation, Summary
from warpfem.solvers import Solver

# --- 12: mass contrast ----------------------------------------------------------------------------------


@case(
    12,
    "mass contrast 1e6 in one body",
    "Hanging from its light half, or from its heavy half: each half is stretched by the weight below it over E A (nu "
    "= 0, strain 1e-4), to 1e-3 of the greater stretch, after implicit steps of 1 s. Let go from a stretch of 1 % in "
    "free flight with explicit steps at half their limit: energy within 10 % of the start, its means over the first "
    "and the last fifth within 2 %, linear momentum below sqrt(steps) roundings of the sum of m |v|.",
)
def mass_contrast(quick: bool) -> Iterator[Trial]:
    for setting in settings(quick):
        for heavy, solver in product(("bottom", "top"), IMPLICIT):
            label = f"{setting}, {solver_name(solver)}, {heavy} half heavy"
            yield attempt(_hanging, label, setting, heavy, solver)
        for explicit in EXPLICIT[1:] if quick else EXPLICIT:
            yield from _contrast_in_flight(f"{setting}, {solver_name(explicit)}", setting, explicit)


def _column(setting: Setting, heavy: str, E: float, **body) -> Body:
    """A column of height 2 with 1 kg/m^3 in one half and 1e6 kg/m^3 in the other."""
    mesh = setting.brick((1.0, 2.0, 1.0), (2, 4, 2))
    upper = mesh.points[mesh.cells].mean(axis=1)[:, 1] > 1.0
    density = np.where(upper == (heavy == "top"), 1e6, 1.0)
    return Body("column", mesh, setting.material(E=E, nu=0.0), density=density, **body)


def _hanging(label: str, setting: Setting, heavy: str, solver: Solver) -> Trial:
    E, g = 1e11, 10.0
    column = _column(setting, heavy, E, supports=[Pin("top")])
    simulation = setting.simulation([column], solver, 1.0, 5, gravity=setting.vector(0.0, -g))
    for _ in simulation.frames():
        pass
    strain = simulation.model.stresses(simulation.state).deformation_gradient[:, 1, 1] - 1.0
    volume, density = column.mesh.cell_volumes, np.asarray(column.density)
    upper = (density == 1e6) == (heavy == "top")
    halves = {"upper": upper, "lower": ~upper}
    weight = {name: g * density[half] @ volume[half] for name, half in halves.items()}
    force = {"upper": weight["lower"] + 0.5 * weight["upper"], "lower": 0.5 * weight["lower"]}  # the area is 1
    expected = {name: force[name] / E for name in halves}
    errors = [abs(strain[half] @ volume[half] / volume[half].sum() - expected[name]) for name, half in halves.items()]
    worst = max(errors) / max(expected.values())
    return at_most(label, worst, 1e-3)


def _contrast_in_flight(label: str, setting: Setting, solver: Solver) -> Iterator[Trial]:
    def stretch(x: np.ndarray) -> np.ndarray:
        return 0.01 * (x - x.mean(axis=0)) * setting.vector(0.0, 1.0)

    column = _column(setting, "bottom", 1e5, displacement=stretch)
    frames, steps = 100, 10
    dt = 0.5 * stable_dt(setting, column, solver)
    simulation = setting.simulation([column], solver, dt, frames, steps)
    yield from _flight(label, simulation, frames * steps, energy_limit=0.1, drift_limit=0.02)


def _flight(
    label: str, simulation: Simulation, steps: int, energy_limit: float, drift_limit: float, spins: bool = False
) -> Iterator[Trial]:
    """Runs a free flight and looks at what it ought to conserve."""
    model = simulation.model
    mass, rest, epsilon = model.lumped_mass, model.rest_points, model.types.epsilon
    energy, linear, angular, size, reach = [], [], [], 0.0, 0.0
    try:
        for frame in simulation.frames():
            x, v = rest + frame.displacement, frame.velocity
            energy.append(frame.energies.total)
            linear.append(momentum(mass, v))
            angular.append(angular_momentum(mass, x, v))
            speed = np.linalg.norm(v, axis=1)
            size = max(size, float(mass @ speed))
            reach = max(reach, float(mass @ (np.linalg.norm(x - mass @ x / mass.sum(), axis=1) * speed)))
    except WarpfemError as error:
        yield Trial(label, "FAIL", "", str(error))
        return
    total = np.array(energy) / energy[0]
    fifth = len(total) // 5
    yield at_most(f"{label}: energy", float(np.abs(total - 1.0).max()), energy_limit)
    yield at_most(f"{label}: drift of energy", float(abs(total[-fifth:].mean() - total[:fifth].mean())), drift_limit)
    allowed = steps**0.5 * epsilon
    change = float(np.linalg.norm(np.array(linear) - linear[0], axis=1).max())
    yield at_most(f"{label}: linear momentum", change / size, allowed)
    if spins:
        change = float(np.linalg.norm(np.array(angular) - angular[0], axis=1).max())
        yield at_most(f"{label}: angular momentum", change / reach, 10.0 * allowed)


# --- 13: time steps and stiffnesses ---------------------------------------------------------------------


@case(
    13,
    "dt from 1e-6 to 10 s at E from 1e3 to 1e11",
    "30 steps. Unloaded from a stretch of 10 % with noise of 1 % and no momentum, backward Euler: the total energy in "
    "the second half of the run is at no time above that halfway, and at the end below that of the start, to 1e-4 of "
    "the start. In free fall from a place 0.1 m from that at rest, implicit steps: the speed is g t to 1e-3, or steps "
    "of one linear solve are reported as not converged or stopped (in float32, hundreds of kilometres away). Pinned, "
    "under gravity, from rest, backward Euler: the total energy, which is 0 at the start, is never above 1e-3 of its "
    "largest part. Single linear solves, unloaded: never above 10 times the start, or reported, or stopped. Explicit "
    "steps, unloaded: below the limit within 35 % of the start, above it refused.",
)
def time_steps(quick: bool) -> Iterator[Trial]:
    for setting in settings(quick):
        for name, solver, measure, limit in (
            ("unloaded, BackwardEuler", NEWTON, _decay, 1e-4),
            ("loaded, BackwardEuler", NEWTON, _gain, 1e-3),
            ("unloaded, linearised backward Euler", LINEARISED, _growth, 10.0),
        ):
            yield _over_time_steps(f"{setting}, {name}", setting, quick, solver, measure, limit)
        for implicit in IMPLICIT:
            for dt in _time_steps(quick):
                label = f"{setting}, free fall, {solver_name(implicit)}, dt = {dt:g} s"
                yield attempt(_fall, label, setting, implicit, dt, may_refuse=implicit == LINEARISED)
        for explicit in EXPLICIT:
            yield _over_time_steps(
                f"{setting}, unloaded, {solver_name(explicit)}", setting, quick, explicit, _swing, 0.35
            )


def _time_steps(quick: bool) -> tuple[float, ...]:
    return (1e-6, 1e-4, 10.0) if quick else (1e-6, 1e-4, 1e-2, 1.0, 10.0)


def _fall(label: str, setting: Setting, solver: Solver, dt: float) -> Trial:
    mesh = setting.brick((1.0, 1.0, 1.0), (2, 2, 2))
    body = Body("block", mesh, setting.material(E=1e5, nu=0.3), displacement=(0.1,) * setting.dim)
    simulation = setting.simulation([body], solver, dt, 30, gravity=setting.vector(0.0, -9.81))
    for frame in simulation.frames():
        last = frame
    mass = simulation.model.lumped_mass
    speed = -momentum(mass, last.velocity)[1] / mass.sum()
    trial = at_most(label, abs(speed / (9.81 * last.time) - 1.0), 1e-3)
    return unless_reported(trial, solver, simulation)


def _over_time_steps(
    label: str, setting: Setting, quick: bool, solver: Solver, measure: Callable[[list[Energies]], float], limit: float
) -> Trial:
    """The worst figure over the time steps and stiffnesses, or what stopped some of them.

    Runs of single linear solves that were reported as not converged, or stopped, do not count, and are told.
    """
    worst, where, stopped, told = -np.inf, "", [], []
    for E, dt in product((1e3, 1e11) if quick else (1e3, 1e5, 1e7, 1e9, 1e11), _time_steps(quick)):
        at = f"E = {E:g} Pa, dt = {dt:g} s"
        try:
            energies, summary = _energies(setting, solver, E, dt, loaded=measure is _gain)
            figure = measure(energies)
        except WarpfemError as error:
            if solver == LINEARISED:
                told.append(f"{at}: {error}")
            elif not (solver in EXPLICIT and isinstance(error, TimeStepError)):
                stopped.append(f"{at}: {error}")
            continue
        if solver == LINEARISED and not figure <= limit and summary.unconverged_steps:
            told.append(f"{at}: {summary.unconverged_steps} of {summary.steps} steps reported as not converged")
        elif not figure <= worst:
            worst, where = figure, at
    if stopped:
        return Trial(label, "FAIL", f"{len(stopped)} runs stopped", stopped[0])
    trial = at_most(f"{label}, worst at {where}", worst, limit)
    if told and trial.status == "pass":
        return Trial(trial.setting, "refused", f"{trial.measured}, without {len(told)} runs", told[0])
    return trial


def _energies(setting: Setting, solver: Solver, E: float, dt: float, loaded: bool) -> tuple[list[Energies], Summary]:
    def displaced(x: np.ndarray) -> np.ndarray:
        noise = np.random.default_rng(1).normal(scale=0.01, size=x.shape)
        return 0.1 * (x - x.mean(axis=0)) * setting.vector(1.0) + noise

    mesh = setting.brick((1.0, 1.0, 1.0), (2, 2, 2))
    material = setting.material(E=E, nu=0.3)
    if loaded:
        body = Body("block", mesh, material, supports=[Pin("left")])
        simulation = setting.simulation([body], solver, dt, 30, gravity=setting.vector(0.0, -9.81))
    else:
        body = Body("block", mesh, material, displacement=displaced)
        simulation = setting.simulation([body], solver, dt, 30)
    return [frame.energies for frame in simulation.frames()], simulation.summary


def _decay(energies: list[Energies]) -> float:
    """The largest rise in the second half, or over the whole run, over the start."""
    total = np.array([energy.total for energy in energies])
    half = len(total) // 2
    return float(max(total[half:].max() - total[half], total[-1] - total[0]) / total[0])


def _gain(energies: list[Energies]) -> float:
    """The largest total over the largest of its parts."""
    largest = max(max(e.kinetic, e.elastic, abs(e.load)) for e in energies)
    return max(e.total for e in energies) / largest


def _growth(energies: list[Energies]) -> float:
    """The largest total over the first."""
    return max(e.total for e in energies) / energies[0].total


def _swing(energies: list[Energies]) -> float:
    """The largest change of the total over the first."""
    return max(abs(e.total / energies[0].total - 1.0) for e in energies)


# --- 14: the limit of explicit steps --------------------------------------------------------------------


@case(
    14,
    "explicit steps at 0.99, 1.01, 2 and 100 times their limit",
    "0.99 times the least limit of the motion: 2000 steps (quick: 300) stay bounded, from noise of 1e-6 of the size, "
    "where all modes move, below the multiple of the energy of the start that the scheme has in its fastest mode, 199 "
    "for symplectic Euler, (1 + 0.99) / (1 - 0.99), 50 for Verlet, 1 / (1 - 0.99^2), and from a stretch of 20 % below "
    "2, or refused where the deformed body turns out to have a lower limit. Above the limit of the start: refused by a "
    "TimeStepError that says the limit to 1e-3.",
)
def explicit_limit(quick: bool) -> Iterator[Trial]:
    for setting, solver in product(settings(quick), EXPLICIT):
        label = f"{setting}, {solver_name(solver)}"
        for name, limit in (("noise", natural_growth(solver, 0.99)), ("stretch", 2.0)):
            where = f"{label}, 0.99, from a {name}"
            yield attempt(_below_limit, where, setting, solver, name, limit, quick, may_refuse=name == "stretch")
        for factor in (1.01, 2.0, 100.0):
            yield _above_limit(f"{label}, {factor:g}", setting, solver, factor)


def _let_go(setting: Setting, start: str) -> Body:
    def noise(x: np.ndarray) -> np.ndarray:
        return np.random.default_rng(1).normal(scale=1e-6, size=x.shape)

    def stretch(x: np.ndarray) -> np.ndarray:
        return 0.2 * (x - x.mean(axis=0)) * setting.vector(1.0)

    mesh = setting.brick((2.0, 1.0, 1.0), (4, 2, 2))
    displacement = noise if start == "noise" else stretch
    return Body("block", mesh, setting.material(E=1e5, nu=0.3), displacement=displacement)


def _below_limit(label: str, setting: Setting, solver: Solver, start: str, limit: float, quick: bool) -> Trial:
    body = _let_go(setting, start)
    dt = stable_dt(setting, body, solver)
    steps, of_a_frame = (300 if quick else 2000), 10
    survey = setting.simulation([body], solver, 0.5 * dt, 2 * steps // of_a_frame, of_a_frame)
    for _ in survey.frames():
        dt = min(dt, survey.stepper.stable_dt(survey.state) or dt)
    simulation = setting.simulation([body], solver, 0.99 * dt, steps // of_a_frame, of_a_frame)
    energies = [frame.energies for frame in simulation.frames()]
    return at_most(label, _growth(energies), limit)


def _above_limit(label: str, setting: Setting, solver: Solver, factor: float) -> Trial:
    body = _let_go(setting, "stretch")
    limit = stable_dt(setting, body, solver)
    try:
        for _ in setting.simulation([body], solver, factor * limit, 10).frames():
            pass
    except TimeStepError as error:
        numbers = [float(number) for number in re.findall(r"\d[\d.]*(?:e[-+]?\d+)?", str(error))]
        said = any(abs(number / limit - 1.0) <= 1e-3 for number in numbers)
        return Trial(label, "refused" if said else "FAIL", "" if said else "the limit is not said", str(error))
    except WarpfemError as error:
        return Trial(label, "FAIL", "not a TimeStepError", str(error))
    return Trial(label, "FAIL", "accepted")


# --- 16: a long flight ----------------------------------------------------------------------------------


@case(
    16,
    "1e5 Verlet steps in free flight",
    "A block that spins, vibrates and travels about five of its lengths, dt half the limit (quick: 2000 steps): at "
    "all frames the energy within 1/3 of the start, the swing that the scheme itself has in its fastest mode, and its "
    "means over the first and the last fifth within 1 %; the linear momentum within sqrt(steps) roundings of the sum "
    "of m |v|; the angular momentum within ten times as many of the sum of m |x| |v| (not for linear elasticity, "
    "whose rotated bodies grow).",
)
def long_flight(quick: bool) -> Iterator[Trial]:
    for setting in settings(quick):
        vibrating = _let_go(setting, "stretch")

        def motion(x: np.ndarray, dim: int = setting.dim) -> np.ndarray:
            return _whirl(x - x.mean(axis=0), 0.5) + (0.01, 0.005, -0.005)[:dim]

        body = Body(
            "block",
            vibrating.mesh,
            vibrating.material,
            displacement=lambda x: 0.05 * (x - x.mean(axis=0)),
            velocity=motion,
        )
        frames, steps = (100, 20) if quick else (200, 500)
        dt = 0.5 * stable_dt(setting, body, VERLET)
        simulation = setting.simulation([body], VERLET, dt, frames, steps)
        rotates = setting.material is not LinearElasticity
        yield from _flight(
            str(setting), simulation, frames * steps, natural_growth(VERLET, 0.5) - 1.0, 0.01, spins=rotates
        )


def _whirl(x: np.ndarray, rate: float) -> np.ndarray:
    """The velocity of a rotation about the last axis at ``rate`` [rad/s]."""
    velocity = np.zeros_like(x)
    velocity[:, 0], velocity[:, 1] = -rate * x[:, 1], rate * x[:, 0]
    return velocity


# --- 17: fast spin --------------------------------------------------------------------------------------


@case(
    17,
    "spin at 100 turns a second",
    "A slender bar of half length L = 0.5 m, nu = 0, E = 1e10 Pa, started in the stretch of the spin. Verlet: after 5 "
    "turns (quick: 1/4) the angle to 1e-3 of it, the stretch rho (w L)^2 / (3 E) to 5 %, the energy to 1 %. Backward "
    "Euler, 1000, 100, 4 and 0.25 steps a turn: the angle that its rule gives a rigid body, tan a' = sin a / (2 - cos "
    "a) step by step, to 1 % (the bar is not quite rigid; not asked of 0.25 steps a turn, which may be taken in "
    "parts), the length to 1 %, and no gain of energy. A soft bar, E = 1e6 Pa, with Verlet, dt = 'auto': energy to 5 "
    "%, angular momentum to 1e-4, or refused. Not for linear elasticity, whose rotated bodies grow.",
)
def spin(quick: bool) -> Iterator[Trial]:
    for setting in settings(quick, without=[LinearElasticity]):
        yield from _verlet_spin(setting, 0.25 if quick else 5.0)
        for steps in (100, 4) if quick else (1000, 100, 4, 0.25):
            label = f"{setting}, BackwardEuler, {steps:g} steps a turn"
            yield from _implicit_spin(label, setting, steps)
        yield from _soft_spin(f"{setting}, VelocityVerlet, soft", setting, 0.1 if quick else 2.0)


SPIN = 200.0 * np.pi  # rad/s
HALF_LENGTH = 0.5  # m


def _bar(setting: Setting, E: float) -> Body:
    mesh = setting.brick((2.0 * HALF_LENGTH, 0.1, 0.1), (20, 2, 2), (-HALF_LENGTH, -0.05, -0.05))

    def steady(x: np.ndarray) -> np.ndarray:
        r = x[:, :1]
        stretch = 1000.0 * SPIN**2 / (2.0 * E) * (HALF_LENGTH**2 * r - r**3 / 3.0)
        return stretch * setting.vector(1.0)

    displacement = steady if E > 1e9 else None
    return Body(
        "bar",
        mesh,
        setting.material(E=E, nu=0.0),
        displacement=displacement,
        velocity=lambda x: _whirl(x + (steady(x) if displacement else 0.0), SPIN),
    )


def _ends(mesh_points: np.ndarray, frame: Frame) -> np.ndarray:
    """The vector from the left to the right end [m]."""
    x = mesh_points + frame.displacement
    left, right = (np.isclose(mesh_points[:, 0], side * HALF_LENGTH) for side in (-1.0, 1.0))
    return x[right].mean(axis=0) - x[left].mean(axis=0)


def _verlet_spin(setting: Setting, turns: float) -> Iterator[Trial]:
    label, E = f"{setting}, VelocityVerlet", 1e10
    bar = _bar(setting, E)
    frames = max(8, int(64 * turns))
    interval = 2.0 * np.pi * turns / SPIN / frames
    steps = int(np.ceil(interval / (0.5 * stable_dt(setting, bar, VERLET))))
    simulation = setting.simulation([bar], VERLET, interval / steps, frames, steps)
    try:
        run = list(simulation.frames())
    except WarpfemError as error:
        yield Trial(label, "FAIL", "", str(error))
        return
    ends = np.array([_ends(bar.mesh.points, frame) for frame in run])
    angle = np.unwrap(np.arctan2(ends[:, 1], ends[:, 0]))[-1] - np.arctan2(ends[0, 1], ends[0, 0])
    yield at_most(f"{label}: angle", abs(angle / (2.0 * np.pi * turns) - 1.0), 1e-3)
    stretch = np.linalg.norm(ends, axis=1).mean() / (2.0 * HALF_LENGTH) - 1.0
    expected = 1000.0 * (SPIN * HALF_LENGTH) ** 2 / (3.0 * E)
    yield at_most(f"{label}: stretch", abs(stretch / expected - 1.0), 0.05)
    yield at_most(f"{label}: energy", _swing([frame.energies for frame in run]), 0.01)


def _implicit_spin(label: str, setting: Setting, steps_a_turn: float) -> Iterator[Trial]:
    dt = 2.0 * np.pi / SPIN / steps_a_turn
    bar = _bar(setting, 1e10)
    count = int(np.clip(0.25 * steps_a_turn, 10, 250))
    simulation = setting.simulation([bar], NEWTON, dt, count)
    try:
        run = list(simulation.frames())
    except WarpfemError as error:
        yield Trial(label, "FAIL", "", str(error))
        return
    ends = np.array([_ends(bar.mesh.points, frame) for frame in run])
    if steps_a_turn >= 4.0:
        turn, expected = np.arctan(SPIN * dt), 0.0
        for _ in range(count):
            expected += turn
            turn = np.arctan2(np.sin(turn), 2.0 - np.cos(turn))
        angle = np.unwrap(np.arctan2(ends[:, 1], ends[:, 0]))
        yield at_most(f"{label}: angle", float(abs((angle[-1] - angle[0]) / expected - 1.0)), 1e-2)
    lengths = np.linalg.norm(ends, axis=1) / (2.0 * HALF_LENGTH)
    yield at_most(f"{label}: length", float(np.abs(lengths - 1.0).max()), 1e-2)
    total = np.array([frame.energies.total for frame in run])
    yield at_most(f"{label}: gain of energy", float(total.max() / total[0] - 1.0), 1e-4)


def _soft_spin(label: str, setting: Setting, turns: float) -> Iterator[Trial]:
    scene = Scene(
        [_bar(setting, 1e6)], VERLET, dt="auto", fps=20.0 * SPIN / (2.0 * np.pi), frames=max(1, round(20.0 * turns))
    )
    simulation = Simulation(scene, device="cpu", dtype=setting.dtype)
    mass, rest = simulation.model.lumped_mass, simulation.model.rest_points
    try:
        run = list(simulation.frames())
    except WarpfemError as error:
        yield Trial(label, "refused" if isinstance(error, SimulationError) else "FAIL", "", str(error))
        return
    yield at_most(f"{label}: energy", _swing([frame.energies for frame in run]), 0.05)
    angular = np.array([angular_momentum(mass, rest + frame.displacement, frame.velocity) for frame in run])
    change = np.linalg.norm(angular - angular[0], axis=1).max() / np.linalg.norm(angular[0])
    yield at_most(f"{label}: angular momentum", float(change), 1e-4)


# --- 18: a great force ----------------------------------------------------------------------------------


@case(
    18,
    "a fixed body pulled by 1000 times its stiffness E A",
    "A bar on rollers under a dead traction of 1000 E, nu = 0.3. Implicit steps of 100 s: within 20 steps the stretch "
    "of the material's law under uniaxial stress to 1e-3, or refused, or, with one linear solve a step, reported as "
    "not converged. Verlet, dt = 'auto': energy and work of the load sum up to 0 within 2 % of the work, or refused.",
)
def great_force(quick: bool) -> Iterator[Trial]:
    for setting in settings(quick):
        for solver in IMPLICIT:
            label = f"{setting}, {solver_name(solver)}"
            yield attempt(_pulled, label, setting, solver, may_refuse=True)
        yield _pulled_explicitly(f"{setting}, VelocityVerlet", setting)


def _pulled_bar(setting: Setting) -> Body:
    mesh = setting.brick((2.0, 1.0, 1.0), (4, 2, 2))
    rollers = [Pin(side, axes=(axis,)) for axis, side in enumerate(("left", "bottom", "back")[: setting.dim])]
    E = 1e5
    pull = Traction("right", setting.vector(1000.0 * E))
    return Body("bar", mesh, setting.material(E=E, nu=0.3), supports=rollers, loads=[pull])


def _pulled(label: str, setting: Setting, solver: Solver) -> Trial:
    bar = _pulled_bar(setting)
    simulation = setting.simulation([bar], solver, 100.0, 20)
    for frame in simulation.frames():
        last = frame
    stretch = 1.0 + last.displacement[bar.mesh.select_points("right"), 0].mean() / 2.0
    expected = uniaxial_stretch(setting, 1e5, 0.3, 1e8)
    trial = at_most(f"{label}, to a stretch of {expected:.4g}", float(abs(stretch / expected - 1.0)), 1e-3)
    return unless_reported(trial, solver, simulation)


def _pulled_explicitly(label: str, setting: Setting) -> Trial:
    scene = Scene([_pulled_bar(setting)], VERLET, dt="auto", fps=100.0, frames=10)
    try:
        run = [f.energies for f in Simulation(scene, device="cpu", dtype=setting.dtype).frames()]
    except WarpfemError as error:
        return Trial(label, "refused" if isinstance(error, SimulationError) else "FAIL", "", str(error))
    return at_most(label, max(abs(e.total) for e in run) / max(abs(e.load) for e in run), 0.02)


def _linear(s: np.ndarray, mu: float, lam: float) -> np.ndarray:
    return 2.0 * mu * (s - 1.0) + lam * (s - 1.0).sum()


def _st_venant_kirchhoff(s: np.ndarray, mu: float, lam: float) -> np.ndarray:
    strain = 0.5 * (s**2 - 1.0)
    return s * (2.0 * mu * strain + lam * strain.sum())


def _neo_hookean(s: np.ndarray, mu: float, lam: float) -> np.ndarray:
    return mu * (s - 1.0 / s) + lam * np.log(s.prod()) / s


def _fixed_corotated(s: np.ndarray, mu: float, lam: float) -> np.ndarray:
    return 2.0 * mu * (s - 1.0) + lam * (s.prod() - 1.0) * s.prod() / s


def _stable_neo_hookean(s: np.ndarray, mu: float, lam: float) -> np.ndarray:
    mu, lam = 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu
    volume = s.prod() - (1.0 + 0.75 * mu / lam)
    return mu * (1.0 - 1.0 / ((s**2).sum() + 1.0)) * s + lam * volume * s.prod() / s


PRINCIPAL_STRESS = {
    "linear": _linear,
    "st_venant_kirchhoff": _st_venant_kirchhoff,
    "neo_hookean": _neo_hookean,
    "fixed_corotated": _fixed_corotated,
    "stable_neo_hookean": _stable_neo_hookean,
}
"""The principal first Piola-Kirchhoff stresses of each material [Pa] from the principal stretches."""


def uniaxial_stretch(setting: Setting, E: float, nu: float, stress: float) -> float:
    """The stretch under a nominal stress [Pa] along x with free sides (2D: plane strain), by bisection."""
    mu, lam = E / (2.0 * (1.0 + nu)), E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    law = PRINCIPAL_STRESS[setting.material.name]
    least = -1e4 if setting.material is LinearElasticity else 1e-12

    def stretches(along: float, across: float) -> np.ndarray:
        return np.array([along, across, 1.0 if setting.dim == 2 else across])

    def contracted(along: float) -> np.ndarray:
        """The stretches with no stress across: St. Venant-Kirchhoff collapses where there are none."""
        across = _root(lambda s: law(stretches(along, s), mu, lam)[1], least, 1.0)
        return stretches(along, across)

    return _root(lambda s: law(contracted(s), mu, lam)[0] - stress, 1.0, 1e5)


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    """Where a function that grows from ``low`` to ``high`` passes zero; the end it is closest to, if nowhere."""
    for _ in range(200):
        middle = 0.5 * (low + high)
        if function(middle) < 0.0:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


# --- 19: impact -----------------------------------------------------------------------------------------


@case(
    19,
    "impact at 100 m/s on a plane and on a sphere",
    "A cube of 0.4 m, E = 1e5 (waves ten times slower than the impact) to 1e9 Pa, flies at a plane and at the middle "
    "of a sphere of radius 1 m, and the run lasts five times the flight through its own length. No boundary point "
    "ever comes below the sphere's centre within its radius or is more than the body's size inside an obstacle; at the "
    "end none is more than a tenth of the size inside; the kinetic, elastic and contact energy is never more than 1.05 "
    "times that of the start with backward Euler, twice with one linear solve a step, which does not see contact that "
    "begins within it, or the multiple that the scheme itself has at the part of its limit that dt = 'auto' takes, 4 "
    "for symplectic Euler, 1.6 for Verlet. Or refused; single linear solves may instead be reported as not converged. "
    "Linear elasticity meets the plane alone: it lets bodies turn round a sphere by growing, at no cost.",
)
def impact(quick: bool) -> Iterator[Trial]:
    solvers: list[tuple[Solver, float | None]] = [
        (NEWTON, 5e-4 if quick else 2e-4),
        (NEWTON, 1.0 / 24.0),
        (VERLET, None),
    ]
    if not quick:
        solvers += [(NEWTON, 1.0 / 120.0), (LINEARISED, 2e-4), (LINEARISED, 1.0 / 120.0), (EXPLICIT[0], None)]
    stiffnesses = (1e5, 1e9) if quick else (1e5, 1e7, 1e9)
    for setting, (solver, dt), E in product(settings(quick), solvers, stiffnesses):
        obstacles: list[Obstacle] = [Plane(setting.vector(), setting.vector(0.0, 1.0))]
        if setting.material is not LinearElasticity:
            obstacles.append(Sphere(setting.vector(0.0, -1.0), 1.0))
        for obstacle in obstacles:
            step = "dt = 'auto'" if dt is None else f"dt = {dt:.3g} s"
            label = f"{setting}, {solver_name(solver)}, {step}, E = {E:g} Pa, {type(obstacle).__name__}"
            yield attempt(_thrown, label, setting, solver, dt, E, obstacle, may_refuse=True)


def _thrown(label: str, setting: Setting, solver: Solver, dt: float | None, E: float, obstacle: Obstacle) -> Trial:
    size, speed = 0.4, 100.0
    mesh = setting.brick((size,) * 3, (3, 3, 3), (-0.5 * size, 0.1, -0.5 * size))
    body = Body("cube", mesh, setting.material(E=E, nu=0.3), velocity=setting.vector(0.0, -speed))
    duration = 5.0 * size / speed
    frames = 20 if dt is None else max(4, round(duration / dt))
    fps = frames / duration if dt is None else 1.0 / dt
    scene = Scene([body], solver, dt=dt or "auto", fps=fps, frames=frames, obstacles=[obstacle])
    simulation = Simulation(scene, device="cpu", dtype=setting.dtype)
    surface = mesh.boundary_points
    behind, deepest, energy = False, 0.0, []
    for frame in simulation.frames():
        x = (mesh.points + frame.displacement)[surface]
        behind |= isinstance(obstacle, Sphere) and bool(
            ((x[:, 1] < -1.0) & (np.linalg.norm(np.delete(x, 1, axis=1), axis=1) < 1.0)).any()
        )
        deepest = max(deepest, frame.penetration)
        energy.append(frame.energies.total)
    figures = f"deepest {deepest:.2g} m, at the end {frame.penetration:.2g} m, energy x {max(energy) / energy[0]:.3g}"
    if behind or deepest > size:
        trial = Trial(label, "FAIL", figures, "tunnels" if behind else "goes in whole")
        return unless_reported(trial, solver, simulation)
    most = natural_growth(solver, AUTO_FRACTION) if solver in EXPLICIT else 2.0 if solver == LINEARISED else 1.05
    if not (frame.penetration <= 0.1 * size and max(energy) <= most * energy[0]):
        return unless_reported(Trial(label, "FAIL", figures), solver, simulation)
    return Trial(label, "pass", figures)
