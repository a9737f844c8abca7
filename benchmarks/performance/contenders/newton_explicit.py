"""Steps of Newton's semi-implicit solver, whose tetrahedra are stable Neo-Hookean with the logarithm."""

import newton
import numpy as np
import warp as wp
from newton_model import build
from serving import Contender, serve, timed


def setup(problem, options):
    if options["material"] != "stable_neo_hookean" or options["threads"] != 1:
        raise SystemExit("Newton's semi-implicit solver has one material and runs on one thread")
    wp.set_device("cpu")
    E, nu = float(problem["E"]), float(problem["nu"])
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    # its energy takes the parameters of Smith et al. (2018), eq. 13, not Lamé's
    model = build(problem, 4 / 3 * mu, lam + 5 / 6 * mu)
    solver = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
    control = model.control()
    dt, steps = float(problem["dt"]), options["steps"]
    start = wp.array((problem["points"] + problem["u"]).astype(np.float32), dtype=wp.vec3)
    states = [model.state(), model.state()]

    def step():
        states[0].clear_forces()
        solver.step(states[0], states[1], control, None, dt)
        states.reverse()

    def reset():
        for state in states:
            wp.copy(state.particle_q, start)
            state.particle_qd.zero_()

    reset()
    step()
    # the forces of a single small step, from the change of velocity
    mass = model.particle_mass.numpy().astype(np.float64)[:, None]
    forces = mass * states[0].particle_qd.numpy().astype(np.float64) / dt

    def run():
        reset()
        return {"seconds": timed(lambda: [step() for _ in range(steps)]) / steps}

    def outcome():
        return {"forces": forces, "displacement": states[0].particle_q.numpy().astype(np.float64) - problem["points"]}

    return Contender(run, outcome)


serve(setup)
