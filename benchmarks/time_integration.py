"""Error against cost of the implicit schemes, those of warpfem and candidates that were not kept.

    python benchmarks/time_integration.py [--quick] [--problem NAME ...]

The motions, all in 2D and float64:

    swing   a cantilever swings freely from an initial velocity
    spin    a free block turns by 0.6 of a turn and vibrates
    drop    a block falls on a floor without friction and rebounds
    slide   the same with friction
    rest    a cantilever is let go under its weight; the state of rest is asked for

The error is the root of the mean square of the displacements' error over the mass, relative to the diagonal of the
body's bounding box: against velocity Verlet with small steps; for ``slide``, since explicit friction is another law,
against SDIRK3 with small steps; for ``rest`` against the static equilibrium. Each line has the Newton and conjugate
gradient iterations and the median processor time of the repeats, without compiling; on a busy machine trust the
iterations. Then, for an error between those of all, each scheme's cost, read off between its lines (or that of its
largest error, if all are less), over the least of all. ``spin`` also tells the change of the angular momentum and of
the energy.

Then the greatest and the last energy over the first, from extreme starts: points put at random, a body squashed to a
tenth, one stretched to three times its size. Last, runs by an error target: what they achieve of it.
"""

import argparse
import contextlib
import statistics
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp
from candidates import BDF2, TRBDF2, Crouzeix, GeneralisedAlpha, Trapezoidal

import warpfem as wf
from warpfem.model import Model, State
from warpfem.solvers import Solver
from warpfem.solvers.error_control import controlled_step
from warpfem.solvers.implicit import ImplicitSolver

SCHEMES: list[ImplicitSolver] = [wf.BackwardEuler(), wf.ImplicitMidpoint(), wf.SDIRK2(), wf.SDIRK3()]
CANDIDATES: list[ImplicitSolver] = [
    Trapezoidal(),
    TRBDF2(),
    BDF2(),
    GeneralisedAlpha(spectral_radius=0.8),
    GeneralisedAlpha(spectral_radius=0.5),
    Crouzeix(),
]


@dataclass(frozen=True)
class Problem:
    """A motion.

    Attributes:
        scene: the scene for a solver.
        duration: simulated time [s].
        steps: numbers of steps.
    """

    scene: Callable[[Solver], wf.Scene]
    duration: float
    steps: tuple[int, ...] = (20, 40, 80, 160)


def _swing(solver: Solver) -> wf.Scene:
    mesh = wf.Mesh.rectangle((2.0, 0.4), (20, 4))
    beam = wf.Body(
        "beam",
        mesh,
        wf.StableNeoHookean(E=1e5, nu=0.3),
        supports=[wf.Pin("left")],
        velocity=lambda x: x[:, :1] ** 2 * [0.0, 1.0],
    )
    return wf.Scene([beam], solver)


def _spin(solver: Solver) -> wf.Scene:
    mesh = wf.Mesh.rectangle((2.0, 1.0), (8, 4), origin=(-1.0, -0.5))
    turn = np.array([[0.0, 2.0], [-2.0, 0.0]])
    block = wf.Body(
        "block",
        mesh,
        wf.StableNeoHookean(E=1e5, nu=0.3),
        velocity=lambda x: x @ turn + 0.2 * np.sin(3.0 * x[:, ::-1]),
    )
    return wf.Scene([block], solver)


def _drop(solver: Solver, friction: float = 0.0) -> wf.Scene:
    mesh = wf.Mesh.rectangle((1.0, 0.5), (12, 6), origin=(0.0, 0.05))
    block = wf.Body("block", mesh, wf.StableNeoHookean(E=5e4, nu=0.3), velocity=(0.3, -1.0))
    floor = wf.Plane((0.0, 0.0), (0.0, 1.0), friction=friction)
    return wf.Scene([block], solver, gravity=(0.0, -9.81), obstacles=[floor])


def _slide(solver: Solver) -> wf.Scene:
    return _drop(solver, friction=0.5)


def _rest(solver: Solver) -> wf.Scene:
    mesh = wf.Mesh.rectangle((2.0, 0.4), (20, 4))
    beam = wf.Body("beam", mesh, wf.StableNeoHookean(E=1e6, nu=0.3), supports=[wf.Pin("left")])
    return wf.Scene([beam], solver, gravity=(0.0, -9.81))


PROBLEMS = {
    "swing": Problem(_swing, 0.6),
    "spin": Problem(_spin, 2.0),
    "drop": Problem(_drop, 0.4),
    "slide": Problem(_slide, 0.4),
    "rest": Problem(_rest, 20.0, (5, 10, 20, 40)),
}


@dataclass
class Run:
    """What a run came to, and what it cost."""

    displacement: np.ndarray
    steps: int
    newton: int
    cg: int
    seconds: float
    energies: np.ndarray
    angular_momentum: np.ndarray


def run(scene: wf.Scene, duration: float, steps: int) -> Run:
    """Runs a scene with steps of the same length."""
    model = Model(scene, device="cpu", dtype="float64")
    scene.solver.stepper(model).prepare(model.state(), duration / steps)
    state, stepper = model.state(), scene.solver.stepper(model)
    newton = cg = 0
    energies, angular, seconds = [model.energies(state).total], [_angular_momentum(model, state)], 0.0
    for _ in range(steps):
        start = time.process_time()
        report = stepper.step(state, duration / steps)
        seconds += time.process_time() - start
        newton, cg = newton + report.newton_iterations, cg + report.cg_iterations
        energies.append(model.energies(state).total)
        angular.append(_angular_momentum(model, state))
    return Run(state.displacement, steps, newton, cg, seconds, np.array(energies), np.array(angular))


def controlled_run(scene: wf.Scene, duration: float, frames: int) -> Run:
    """Runs a scene whose solver has an error target."""
    model = Model(scene, device="cpu", dtype="float64")
    state, stepper = model.state(), scene.solver.stepper(model)
    stepper.prepare(state, duration / frames)
    interval = wanted = duration / frames
    steps = newton = cg = 0
    start = time.process_time()
    for frame in range(1, frames + 1):
        while (left := frame * interval - state.time) > 1e-9 * interval:
            step = controlled_step(stepper, scene.solver.order, state, left, wanted, interval)
            wanted, steps = step.wanted, steps + 1
            newton, cg = newton + step.report.newton_iterations, cg + step.report.cg_iterations
    seconds = time.process_time() - start
    return Run(state.displacement, steps, newton, cg, seconds, np.empty(0), np.empty(0))


def _angular_momentum(model: Model, state: State) -> float:
    x, v = model.rest_points + state.displacement, state.velocity
    return float(model.lumped_mass @ (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]))


def reference(name: str, problem: Problem, quick: bool) -> np.ndarray:
    """The displacements at the end to compare with."""
    if name == "rest":
        model = Model(problem.scene(wf.BackwardEuler()), device="cpu", dtype="float64")
        state = model.state()
        wf.StaticEquilibrium(tolerance=1e-9).solve(model, state)
        return state.displacement
    if name == "slide":
        scene = problem.scene(wf.SDIRK3(tolerance=1e-8))
        return run(scene, problem.duration, 1000 if quick else 3000).displacement
    scene = problem.scene(wf.VelocityVerlet())
    model = Model(scene, device="cpu", dtype="float64")
    limit = scene.solver.stepper(model).stable_dt(model.state())
    assert limit is not None
    return run(scene, problem.duration, int(np.ceil(problem.duration / (0.12 * limit)))).displacement


def error(scene: wf.Scene, u: np.ndarray, expected: np.ndarray) -> float:
    """Root of the mean square over the mass, relative to the diagonal of the body's bounding box."""
    model = Model(scene, device="cpu", dtype="float64")
    mass, (body,) = model.lumped_mass, scene.bodies
    size = np.linalg.norm(np.ptp(body.mesh.bounding_box, axis=0))
    return float(np.sqrt(mass @ ((u - expected) ** 2).sum(axis=1) / mass.sum()) / size)


def _name(solver: ImplicitSolver) -> str:
    radius = getattr(solver, "spectral_radius", None)
    return type(solver).__name__ + (f" {radius}" if radius else "")


def front(name: str, problem: Problem, quick: bool) -> None:
    """Prints error and cost of all schemes for a motion, and the time of each for one error."""
    expected = reference(name, problem, quick)
    cases = [(solver, steps) for steps in problem.steps[: 2 if quick else 4] for solver in [*SCHEMES, *CANDIDATES]]
    runs: dict[tuple[ImplicitSolver, int], list[Run]] = {}
    for _ in range(1 if quick else 3):  # by turns, so that what else the machine does falls on all of them
        for solver, steps in cases:
            with contextlib.suppress(wf.SimulationError, AssertionError):
                runs.setdefault((solver, steps), []).append(run(problem.scene(solver), problem.duration, steps))
    print(f"\n{name}\n{'scheme':22} steps     error  Newton     CG  seconds")
    lines: dict[str, list[tuple[float, float, float]]] = {}
    for solver, steps in sorted(cases, key=lambda case: [*SCHEMES, *CANDIDATES].index(case[0])):
        if (solver, steps) not in runs:
            print(f"{_name(solver):22} {steps:5d}  fails")
            continue
        one = runs[solver, steps][0]
        seconds = statistics.median(own.seconds for own in runs[solver, steps])
        off = error(problem.scene(solver), one.displacement, expected)
        lines.setdefault(_name(solver), []).append((off, one.newton, seconds))
        told = f"{_name(solver):22} {steps:5d} {off:9.2e} {one.newton:7d} {one.cg:6d} {seconds:8.3f}"
        if name == "spin":
            lost = one.angular_momentum[-1] / one.angular_momentum[0] - 1.0
            told += f"  angular momentum {lost:+.1e}, energy {one.energies[-1] / one.energies[0] - 1.0:+.1e}"
        print(told, flush=True)
    _compare(lines)


def _compare(lines: dict[str, list[tuple[float, float, float]]]) -> None:
    """Prints Newton iterations and time for the error in the middle of all."""
    target = float(np.exp(np.median([np.log(line[0]) for own in lines.values() for line in own])))
    costs, short = {}, []
    for name, own in lines.items():
        off, *cost = np.log(np.array(sorted(own))).T
        if off[0] > np.log(target):
            short.append(name)
        else:  # with larger errors than any of its own, a scheme would take at most its least cost
            costs[name] = [float(np.exp(np.interp(np.log(target), off, one))) for one in cost]
    least = np.min(list(costs.values()), axis=0)
    print(f"for an error of {target:.1e} (not reached: {', '.join(short) or 'none'}), over the least: Newton, seconds")
    for name, cost in sorted(costs.items(), key=lambda item: item[1]):
        print(f"  {name:22} {cost[0] / least[0]:5.2f} {cost[1] / least[1]:5.2f}")


STARTS: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "random": lambda x, rng: rng.uniform(-0.5, 0.5, x.shape),
    "squashed": lambda x, rng: -0.9 * x + rng.normal(scale=0.01, size=x.shape),
    "stretched": lambda x, rng: 2.0 * x,
}


def extreme_starts(quick: bool) -> None:
    """Prints how the energy goes from extreme starts, 30 steps of three lengths."""
    print("\nenergy from extreme starts: greatest / last, over the first")
    print(f"{'scheme':22}" + "".join(f"{f'{start}, {dt} s':>22}" for start, dt in _cases(quick)))
    for solver in [*SCHEMES, *CANDIDATES]:
        told = f"{_name(solver):22}"
        for start, dt in _cases(quick):
            mesh = wf.Mesh.rectangle((1.0, 1.0), (4, 4))
            u = STARTS[start](mesh.points, np.random.default_rng(0))
            block = wf.Body("block", mesh, wf.StableNeoHookean(E=1e5, nu=0.3), displacement=u)
            try:
                energies = run(wf.Scene([block], solver), 30 * dt, 30).energies
                told += f"{f'{energies.max() / energies[0]:.3g} / {energies[-1] / energies[0]:.1e}':>22}"
            except (wf.SimulationError, AssertionError):
                told += f"{'fails':>22}"
        print(told, flush=True)


def _cases(quick: bool) -> Iterator[tuple[str, float]]:
    for start in STARTS:
        for dt in (0.04,) if quick else (0.3, 0.04, 0.01):
            yield start, dt


def targets(name: str, problem: Problem, quick: bool) -> None:
    """Prints what runs by an error target achieve of it, ten frames long."""
    expected = reference(name, problem, quick)
    for scheme in (wf.SDIRK2, wf.SDIRK3):
        for target in (1e-1, 1e-2) if quick else (1e-1, 1e-2, 1e-3, 1e-4):
            scene = problem.scene(scheme(error=target))
            one = controlled_run(scene, problem.duration, 10)
            off = error(scene, one.displacement, expected)
            allowed = target * problem.duration
            print(
                f"{name:8} {scheme.__name__:8} {allowed:8.1e} {off:9.1e} {off / allowed:9.2f} {one.steps:7d} "
                f"{one.newton:7d} {one.cg:6d} {one.seconds:8.2f}",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer steps, one repeat: some minutes")
    parser.add_argument("--problem", nargs="*", choices=PROBLEMS, default=list(PROBLEMS), help="motions to measure")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    warnings.simplefilter("ignore", UserWarning)  # of inverted cells
    for name in arguments.problem:
        front(name, PROBLEMS[name], arguments.quick)
    extreme_starts(arguments.quick)
    print("\nerror targets\nmotion   scheme    allowed  achieved  achieved/allowed  steps  Newton     CG  seconds")
    for name in arguments.problem:
        if name != "rest":
            targets(name, PROBLEMS[name], arguments.quick)


if __name__ == "__main__":
    main()
