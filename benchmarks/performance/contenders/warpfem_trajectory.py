"""The swing of a beam with warpfem, by several schemes and steps."""

import numpy as np
from serving import serve
from trajectories import follow

import warpfem as wf
from warpfem.simulation import Simulation


def setup(problem, options):
    mesh = wf.Mesh(problem["points"], problem["cells"]).with_point_set("fixed", np.flatnonzero(problem["fixed"]))
    material = wf.StableNeoHookean(E=float(problem["E"]), nu=float(problem["nu"]))
    body = wf.Body("beam", mesh, material, density=float(problem["density"]), supports=[wf.Pin("fixed")])
    interval = float(problem["interval"])

    def prepare(setting):
        scheme, steps = setting
        solver = wf.BackwardEuler.linearised() if scheme == "linearised" else wf.SOLVERS[scheme]()
        gravity = (0.0, float(problem["gravity"]), 0.0)
        scene = wf.Scene([body], solver, gravity=gravity, dt=interval / steps, fps=1.0 / interval, frames=1)
        simulation = Simulation(scene, threads=options["threads"])
        states = []

        def reset():
            states[:] = [simulation.model.state()]

        def advance(duration):
            try:
                left = steps
                while left:
                    left -= simulation.stepper.advance(states[0], duration / steps, left)[0]
            except wf.SimulationError:
                return np.array(np.nan)
            return states[0].displacement

        return reset, advance

    return follow(options["settings"], prepare, problem)


serve(setup)
