"""One linearised step of backward Euler with warpfem, from the same state at each turn."""

import numpy as np
from serving import Contender, serve, settled, timed

import warpfem as wf
from warpfem.model import Model
from warpfem.simulation import Simulation


def setup(problem, options):
    mesh = wf.Mesh(problem["points"], problem["cells"])
    kind = {m.name: m for m in (wf.StableNeoHookean, wf.FixedCorotated)}[options["material"]]
    material = kind(E=float(problem["E"]), nu=float(problem["nu"]))
    body = wf.Body("box", mesh, material, density=float(problem["density"]), displacement=problem["u"])
    dt = float(problem["dt"])
    solver = wf.BackwardEuler.linearised(linear_tolerance=options["tolerance"], **options["settings"])
    scene = wf.Scene([body], solver, gravity=(0.0, 0.0, 0.0), dt=dt, fps=1.0 / dt, frames=1)
    simulation = Simulation(scene, threads=options["threads"])
    last = {}

    def run():
        state = simulation.model.state()
        reports = []
        seconds = timed(lambda: reports.append(simulation.stepper.step(state, dt)))
        last["velocity"] = state.velocity
        return {"seconds": seconds, "iterations": reports[0].cg_iterations}

    exact = Model(scene, dtype="float64")
    state = exact.state()
    mass = exact.lumped_mass[:, None]
    right = dt * exact.internal_force(state)

    def outcome():
        """The relative residual of (M + dt^2 K) v = dt f, in float64 whatever the step was taken in."""
        v = last["velocity"]
        product = mass * v - dt * dt * exact.force_differential(state, v)
        return {"residual": np.atleast_1d(np.linalg.norm(right - product) / np.linalg.norm(right)), "velocity": v}

    return Contender(settled(run), outcome)


serve(setup)
