"""The swing of a beam with Newton's vertex block descent or its semi-implicit solver, steps recorded as a graph."""

import newton
import numpy as np
import warp as wp
from newton_model import build
from serving import serve
from trajectories import follow


def setup(problem, options):
    wp.set_device("cpu")
    E, nu = float(problem["E"]), float(problem["nu"])
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    descent = options["solver"] == "vbd"
    # vertex block descent takes Lamé's parameters; the other those of Smith et al. (2018), eq. 13
    parameters = (mu, lam) if descent else (4 / 3 * mu, lam + 5 / 6 * mu)
    model = build(problem, *parameters, gravity=float(problem["gravity"]), coloured=descent)
    start = wp.array(problem["points"].astype(np.float32), dtype=wp.vec3)

    def prepare(setting):
        steps, iterations = setting
        dt = float(problem["interval"]) / steps
        if descent:
            solver = newton.solvers.SolverVBD(model, iterations=iterations, particle_enable_tile_solve=False)
        else:
            solver = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
        control = model.control()
        states = [model.state(), model.state()]

        def reset():
            for state in states:
                wp.copy(state.particle_q, start)
                state.particle_qd.zero_()

        def pair():
            for a, b in (states, states[::-1]):
                a.clear_forces()
                solver.step(a, b, control, None, dt)

        reset()
        pair()
        with wp.ScopedCapture() as capture:
            pair()

        def advance(duration):
            for _ in range(steps // 2):
                wp.capture_launch(capture.graph)
            return states[0].particle_q.numpy().astype(np.float64) - problem["points"]

        return reset, advance

    return follow(options["settings"], prepare, problem)


serve(setup)
