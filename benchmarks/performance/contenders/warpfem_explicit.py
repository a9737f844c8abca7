"""Steps of symplectic Euler with warpfem."""

import time

import numpy as np
from serving import Contender, serve

import warpfem as wf
from warpfem.model import device_bytes
from warpfem.simulation import Simulation


def setup(problem, options):
    kind = {m.name: m for m in (wf.StableNeoHookean, wf.NeoHookean, wf.FixedCorotated)}[options["material"]]
    mesh = wf.Mesh(problem["points"], problem["cells"]).with_point_set("fixed", np.flatnonzero(problem["fixed"]))
    body = wf.Body(
        "box",
        mesh,
        kind(E=float(problem["E"]), nu=float(problem["nu"])),
        density=float(problem["density"]),
        supports=[wf.Pin("fixed")],
        displacement=problem["u"],
    )
    dt, steps = float(problem["dt"]), options["steps"]
    scene = wf.Scene([body], wf.SymplecticEuler(), gravity=(0.0, 0.0, 0.0), dt=dt, fps=1.0 / dt, frames=1)
    simulation = Simulation(scene, threads=options["threads"])
    model, stepper = simulation.model, simulation.stepper
    force = model.zeros()
    model.force(simulation.state.u, force)
    forces = force.numpy().astype(np.float64)
    last = {}

    def run():
        state = model.state()
        stepper.prepare(state, dt)
        stepper.step(state, dt)  # sets the watch over stability up for the new state
        start = time.perf_counter()
        for _ in range(steps - 1):
            stepper.step(state, dt)
        seconds = time.perf_counter() - start
        last["displacement"] = state.u.numpy().astype(np.float64)
        return {"seconds": seconds / (steps - 1)}

    held = device_bytes([*model.arrays(), *stepper.arrays(), simulation.state.u, simulation.state.v])
    return Contender(run, lambda: {"forces": forces, **last}, {"device_bytes": held})


serve(setup)
