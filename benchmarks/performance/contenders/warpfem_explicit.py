"""Steps of symplectic Euler with warpfem."""

import numpy as np
from serving import Contender, serve, timed

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
    state = model.state()
    last = {}

    def advance():
        left = steps
        while left:  # as a simulation does up to the next frame
            left -= stepper.advance(state, dt, left)[0]

    def run():
        """Goes on from where the last turn ended, so that its share of the looks at stability is that of a long run."""
        seconds = timed(advance)
        last.setdefault("displacement", state.displacement)  # after the first turn, as the others have it
        return {"seconds": seconds / steps}

    held = device_bytes([*model.arrays(), *stepper.arrays(), state.u, state.v])
    return Contender(run, lambda: {"forces": forces, **last}, {"device_bytes": held})


serve(setup)
