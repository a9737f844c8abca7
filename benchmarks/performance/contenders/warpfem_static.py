"""The static equilibrium of a beam under its weight with warpfem, from its rest shape at each turn."""

import numpy as np
from serving import Contender, serve, timed

import warpfem as wf
from warpfem.model import Model


def setup(problem, options):
    kind = {m.name: m for m in (wf.LinearElasticity, wf.NeoHookean)}[options["material"]]
    mesh = wf.Mesh(problem["points"], problem["cells"]).with_point_set("fixed", np.flatnonzero(problem["fixed"]))
    material = kind(E=float(problem["E"]), nu=float(problem["nu"]))
    body = wf.Body("beam", mesh, material, density=float(problem["density"]), supports=[wf.Pin("fixed")])
    scene = wf.Scene([body], wf.BackwardEuler(), gravity=(0.0, float(problem["gravity"]), 0.0))
    solver = wf.StaticEquilibrium(tolerance=options["tolerance"], linear_solver=options.get("linear_solver", "auto"))
    last = {}

    def run():
        def solve():
            model = Model(scene, dtype=options["dtype"], threads=options["threads"])  # the others assemble anew too
            state = model.state()
            last["report"] = solver.solve(model, state)
            last["displacement"] = state.displacement

        seconds = timed(solve)
        report = last["report"]
        return {"seconds": seconds, "iterations": report.cg_iterations, "newton": report.newton_iterations}

    return Contender(run, lambda: {"displacement": last["displacement"]})


serve(setup)
