"""Cases on degenerate scenes: slivers, nothing to move or nothing to hold, numbers that are none."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from warpfem.boundary import Pin, Plane, PointForce, PointSelection, PrescribedMotion, Sphere, Traction
from warpfem.errors import WarpfemError
from warpfem.extremes.motion import (
    EXPLICIT,
    IMPLICIT,
    VERLET,
    Setting,
    attempt,
    natural_growth,
    settings,
    solver_name,
    stable_dt,
    unless_reported,
)
from warpfem.extremes.table import Trial, at_most, case, refused
from warpfem.materials import StableNeoHookean
from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.record import run
from warpfem.scene import Body, Scene
from warpfem.solvers import Solver, StaticEquilibrium

# --- 15: slivers ----------------------------------------------------------------------------------------


@case(
    15,
    "slivers of quality 1e-3 to 1e-6",
    "A body of 2 m with one such cell in its middle is let go from a stretch of 10 %. Implicit steps of 1 s: after "
    "20 the elastic energy is below 1e-6 of the start, a strain of 1e-4; or refused in float32 where the cell is less "
    "than ten roundings of the size high, that is below quality 1e-5 in 2D and 1e-3 in 3D; or, with one linear solve a "
    "step, reported as not converged. Explicit steps of half the limit, which the cell sets, with random velocities of "
    "0.1 m/s, which make it quiver, refused in float32 likewise: in 400 of them the energy "
    "stays below the multiple of the start that the scheme itself has, 3 for symplectic Euler, 4/3 for Verlet.",
)
def slivers(quick: bool) -> Iterator[Trial]:
    for setting, quality in product(settings(quick), (1e-3, 1e-6) if quick else (1e-3, 1e-4, 1e-5, 1e-6)):
        coarse = setting.dtype == "float32" and quality < (1e-5 if setting.dim == 2 else 1e-3)
        for solver in IMPLICIT:
            label = f"{setting}, {solver_name(solver)}, {quality:g}"
            yield attempt(_recovery, label, setting, solver, sliver(setting.dim, quality), may_refuse=coarse)
        for explicit in EXPLICIT[1:] if quick else EXPLICIT:
            label = f"{setting}, {solver_name(explicit)}, {quality:g}"
            yield attempt(_bounded, label, setting, explicit, sliver(setting.dim, quality), may_refuse=coarse)


def sliver(dim: int, quality: float) -> Mesh:
    """A body of about 2 m whose cell 0 has that mean-ratio quality.

    In the plane a triangle with one point nearly on the opposite edge; in space four points nearly on a square,
    its diagonals a little apart, between two apexes.
    """

    def mesh(height: float) -> Mesh:
        if dim == 2:
            points = [[-1.0, 0.0], [1.0, 0.0], [0.0, height], [0.0, 2.0]]
            return Mesh(np.array(points), np.array([[0, 1, 2], [1, 3, 2], [3, 0, 2]]))
        square = [[1.0, 0.0, height], [0.0, 1.0, -height], [-1.0, 0.0, height], [0.0, -1.0, -height]]
        points = [*square, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
        cells = [[0, 1, 2, 3], [0, 2, 1, 4], [0, 2, 3, 4], [1, 3, 0, 5], [1, 3, 2, 5]]
        return Mesh.repaired(np.array(points), np.array(cells))

    power = 1.0 if dim == 2 else 2.0 / 3.0  # of the height in the quality of a flat cell
    height = 1e-6
    for _ in range(3):
        height *= (quality / mesh(height).quality[0]) ** (1.0 / power)
    return mesh(height)


def _let_go(setting: Setting, mesh: Mesh, speed: float = 0.0) -> Body:
    def stretch(x: np.ndarray) -> np.ndarray:
        return 0.1 * x * setting.vector(1.0)

    def quiver(x: np.ndarray) -> np.ndarray:
        return np.random.default_rng(1).normal(scale=speed, size=x.shape)

    return Body("body", mesh, setting.material(E=1e5, nu=0.3), displacement=stretch, velocity=quiver)


def _recovery(label: str, setting: Setting, solver: Solver, mesh: Mesh) -> Trial:
    simulation = setting.simulation([_let_go(setting, mesh)], solver, 1.0, 20)
    frames = list(simulation.frames())
    trial = at_most(label, frames[-1].energies.elastic / frames[0].energies.elastic, 1e-6)
    return unless_reported(trial, solver, simulation)


def _bounded(label: str, setting: Setting, solver: Solver, mesh: Mesh) -> Trial:
    body = _let_go(setting, mesh, speed=0.1)
    simulation = setting.simulation([body], solver, 0.5 * stable_dt(setting, body, solver), 20, 20)
    total = [frame.energies.total for frame in simulation.frames()]
    return at_most(label, max(total) / total[0], natural_growth(solver, 0.5))


# --- 20: degenerate scenes ------------------------------------------------------------------------------


@case(
    20,
    "everything pinned, one element, zero gravity, zero frames",
    "Everything pinned, under gravity: no displacement and no velocity at all after 5 steps. One element let go from "
    "a stretch of 10 %: as a body with a sliver. Gravity of zero: the bits of a scene without. No frames: the initial "
    "one alone, without a step, also in a file. A static equilibrium with nothing pinned: refused, with the rigid "
    "motions by name; with everything pinned: no displacement.",
)
def degenerate(quick: bool) -> Iterator[Trial]:
    for setting in settings(quick):
        label = f"{setting}, StaticEquilibrium, nothing pinned"
        modes = ["translation along y", "rotation about (0.5" if setting.dim == 2 else "rotation about z through (0.5"]
        yield refused(label, partial(_static, setting, ()), "body 'body'", *modes)
        label = f"{setting}, StaticEquilibrium, everything pinned"
        yield attempt(_static_pinned, label, setting)
        corners = np.concatenate([np.zeros((1, setting.dim)), np.eye(setting.dim)])
        simplex = Mesh(corners, np.arange(setting.dim + 1)[None])
        for solver in (*IMPLICIT, *EXPLICIT):
            label = f"{setting}, {solver_name(solver)}"
            yield attempt(_all_pinned, f"{label}, everything pinned", setting, solver)
            one = _bounded if solver in EXPLICIT else _recovery
            yield attempt(one, f"{label}, one element", setting, solver, simplex)
            yield attempt(_no_gravity, f"{label}, zero gravity", setting, solver)
            yield attempt(_no_frames, f"{label}, zero frames", setting, solver)


def _brick(setting: Setting) -> Mesh:
    return setting.brick((1.0, 1.0, 1.0), (2, 2, 2))


def _static(setting: Setting, points: PointSelection) -> np.ndarray:
    """The displacement of a brick under its weight, pinned at these points."""
    body = Body("body", _brick(setting), setting.material(E=1e5, nu=0.3), supports=[Pin(points)] if len(points) else [])
    scene = Scene([body], IMPLICIT[0], gravity=setting.vector(0.0, -9.81))
    model = Model(scene, device="cpu", dtype=setting.dtype)
    state = model.state()
    StaticEquilibrium().solve(model, state)
    return state.displacement


def _static_pinned(label: str, setting: Setting) -> Trial:
    everything = np.arange(_brick(setting).point_count)
    return at_most(label, float(np.abs(_static(setting, everything)).max()), 0.0)


def _all_pinned(label: str, setting: Setting, solver: Solver) -> Trial:
    mesh = _brick(setting)
    body = Body("body", mesh, setting.material(E=1e5, nu=0.3), supports=[Pin(np.arange(mesh.point_count))])
    simulation = setting.simulation([body], solver, 1e-3, 5, gravity=setting.vector(0.0, -9.81))
    for frame in simulation.frames():
        last = frame
    return at_most(label, float(max(np.abs(last.displacement).max(), np.abs(last.velocity).max())), 0.0)


def _no_gravity(label: str, setting: Setting, solver: Solver) -> Trial:
    def motion(gravity: tuple[float, ...] | None) -> np.ndarray:
        body = Body("body", _brick(setting), setting.material(E=1e5, nu=0.3), velocity=lambda x: np.sin(3.0 * x))
        simulation = setting.simulation([body], solver, 1e-3, 5, gravity=gravity)
        return np.array([(frame.displacement, frame.velocity) for frame in simulation.frames()])

    return at_most(label, float(np.abs(motion(setting.vector(0.0)) - motion(None)).max()), 0.0)


def _no_frames(label: str, setting: Setting, solver: Solver) -> Trial:
    body = Body("body", _brick(setting), setting.material(E=1e5, nu=0.3), velocity=setting.vector(1.0))
    simulation = setting.simulation([body], solver, 1e-3, 0)
    frames = list(simulation.frames())
    with TemporaryDirectory() as folder:
        path = Path(folder) / "none.usda"
        summary = run(simulation.scene, path, device="cpu", dtype=setting.dtype)
        stored = path.exists()
    moved = float(np.abs(frames[-1].displacement).max())
    alone = len(frames) == summary.frames == 1 and simulation.summary.steps == summary.steps == 0 and stored
    return Trial(label, "pass" if alone and moved == 0.0 else "FAIL", f"{len(frames)} frame, {summary.steps} steps")


# --- 21: not a number -----------------------------------------------------------------------------------

BAD = (np.nan, np.inf)


@case(
    21,
    "NaN or infinity in the state, the mesh, a parameter, a prescribed motion",
    "Of two bodies the second is the one. What is declared is refused with the place: the point or the cell, and the "
    "body where there is one. What appears while a run goes stops it by the end of the next frame with an error that "
    "says the time, the body, and a point or cell of it.",
)
def not_a_number(quick: bool) -> Iterator[Trial]:
    for bad in BAD[:1] if quick else BAD:
        yield from _declared(bad)
        for setting, solver in product(settings(quick), (*IMPLICIT, *EXPLICIT)):
            label = f"{setting}, {solver_name(solver)}, {bad:g}"
            for place in ("displacement", "velocity", "cell"):
                yield _appears(f"{label} in the {place} of a run", setting, solver, bad, place)
            yield _moves(f"{label} from a prescribed motion at 0.003 s", setting, solver, bad)


def _declared(bad: float) -> Iterator[Trial]:
    mesh = Mesh.box((1.0, 1.0, 1.0), (1, 1, 1))
    cells, material = mesh.cell_count, StableNeoHookean(E=1e5, nu=0.3)

    def spoiled(shape: int | tuple[int, int], index: int) -> np.ndarray:
        values = np.ones(shape)
        values[index] = bad
        return values

    def moduli(E: float | np.ndarray = 1e5, nu: float | np.ndarray = 0.3) -> object:
        return StableNeoHookean(E=E, nu=nu)

    def scene(**settings) -> object:
        first = Body("first", mesh, material)
        loads = settings.pop("loads", ())
        body = {name: settings.pop(name) for name in ("density", "displacement", "velocity") if name in settings}
        bodies = [first, Body("second", mesh, material, loads=loads, **body)]
        return [*Scene(bodies, VERLET, frames=1, **settings).bodies, setting_simulation(bodies, settings)]

    def setting_simulation(bodies: list[Body], settings: dict) -> object:
        return Setting(StableNeoHookean, 3, "float64").simulation(bodies, VERLET, 1e-4, 1, **settings)

    trials: list[tuple[str, Callable[[], object], tuple[str, ...]]] = [
        ("mesh", lambda: Mesh(mesh.points * spoiled((8, 1), 3), mesh.cells), ("point 3",)),
        ("E of a cell", lambda: moduli(E=spoiled(cells, 2)), ("E must be", "cell 2")),
        ("nu of a cell", lambda: moduli(nu=0.3 * spoiled(cells, 2)), ("nu must be", "cell 2")),
        ("E", lambda: moduli(E=bad), ("E must be",)),
        ("nu", lambda: moduli(nu=bad), ("nu must be",)),
        ("density of a cell", lambda: scene(density=spoiled(cells, 2)), ("second", "density", "cell 2")),
        ("initial displacement", lambda: scene(displacement=spoiled((8, 3), 3)), ("second", "displacement", "3")),
        ("initial velocity", lambda: scene(velocity=spoiled((8, 3), 3)), ("second", "velocity", "3")),
        ("gravity", lambda: scene(gravity=(0.0, bad, 0.0)), ("gravity",)),
        ("damping", lambda: scene(damping=bad), ("damping",)),
        ("point force", lambda: scene(loads=[PointForce([0], (bad, 0.0, 0.0))]), ("PointForce",)),
        ("traction", lambda: scene(loads=[Traction("top", (bad, 0.0, 0.0))]), ("Traction",)),
        ("plane", lambda: scene(obstacles=[Plane((0.0, bad, 0.0), (0.0, 1.0, 0.0))]), ("Plane",)),
        ("sphere", lambda: scene(obstacles=[Sphere((0.0, 0.0, 0.0), bad)]), ("Sphere",)),
        ("assigned displacement", lambda: _assign(mesh, displacement=spoiled((8, 3), 3)), ("point 3",)),
        ("assigned velocity", lambda: _assign(mesh, velocity=spoiled((8, 3), 3)), ("point 3",)),
    ]
    for name, action, words in trials:
        yield refused(f"{bad:g} in the {name}", action, *words)


def _assign(mesh: Mesh, **values: np.ndarray) -> None:
    body = Body("body", mesh, StableNeoHookean(E=1e5, nu=0.3))
    simulation = Setting(StableNeoHookean, 3, "float64").simulation([body], VERLET, 1e-4, 1)
    simulation.state.assign(**values)


def _two_bodies(setting: Setting, **second) -> list[Body]:
    material = setting.material(E=1e5, nu=0.3)
    first = Body("first", _brick(setting), material)
    beside = setting.brick((1.0, 1.0, 1.0), (2, 2, 2), (2.0, 0.0, 0.0))
    return [first, Body("second", beside, material, **second)]


def _appears(label: str, setting: Setting, solver: Solver, bad: float, place: str) -> Trial:
    simulation = setting.simulation(_two_bodies(setting), solver, 1e-3, 4, gravity=setting.vector(0.0, -9.81))
    frames, state, model = simulation.frames(), simulation.state, simulation.model
    next(frames)
    last = next(frames)
    if place == "cell":  # as if its rest shape had been bad
        model.blocks[0].arguments["inverse_shape"].numpy()[model.cell_starts[1] + 2] = bad
    else:
        (state.u if place == "displacement" else state.v).numpy()[model.point_starts[1] + 2] = bad
        state.revision += 1
    return _stops(label, lambda: next(frames), last.time, simulation.dt)


def _moves(label: str, setting: Setting, solver: Solver, bad: float) -> Trial:
    def motion(rest: np.ndarray, time: float) -> np.ndarray:
        return rest + (bad if time > 0.0025 else 0.0)

    bodies = _two_bodies(setting, supports=[PrescribedMotion("left", motion)])
    simulation = setting.simulation(bodies, solver, 1e-3, 4)
    return _stops(label, lambda: list(simulation.frames()), 2.0 * simulation.dt, simulation.dt)


def _stops(label: str, action: Callable[[], object], time: float, dt: float) -> Trial:
    """A refusal of the step from ``time`` that says where it is."""
    try:
        action()
    except WarpfemError as error:
        said = str(error)
        times = any(f"t = {moment:.{digits}g} s" in said for moment in (time, time + dt) for digits in (3, 6))
        parts = {
            "the time": times,
            "the body": "'second'" in said,
            "a point or cell": "point" in said or "cell" in said,
        }
        missing = [part for part, found in parts.items() if not found]
        if missing:
            return Trial(label, "FAIL", "unclear", f"the message lacks {', '.join(missing)}: {said}")
        return Trial(label, "refused", "", said)
    return Trial(label, "FAIL", "went on")
