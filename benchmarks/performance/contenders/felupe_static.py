"""The static equilibrium of a Neo-Hookean beam under its weight with FElupe: Newton's method, its usual sparse LU."""

import felupe
import numpy as np
from serving import Contender, serve, timed


def setup(problem, options):
    E, nu = float(problem["E"]), float(problem["nu"])
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    mesh = felupe.Mesh(problem["points"], problem["cells"], "tetra")
    last = {}

    def solve():
        field = felupe.FieldContainer([felupe.Field(felupe.RegionTetra(mesh), dim=3)])
        solid = felupe.SolidBody(felupe.NeoHookeCompressible(mu=mu, lmbda=lam), field)
        pull = [0.0, float(problem["gravity"]), 0.0]
        weight = felupe.SolidBodyForce(field, values=pull, scale=float(problem["density"]))
        held = felupe.Boundary(field[0], mask=problem["fixed"].astype(bool))
        dof0, dof1 = felupe.dof.partition(field, {"held": held})
        found = felupe.newtonraphson(
            items=[solid, weight], dof0=dof0, dof1=dof1, tol=options["tolerance"], verbose=False
        )
        last["displacement"] = found.x[0].values
        last["newton"] = found.iterations

    return Contender(
        lambda: {"seconds": timed(solve), "newton": last["newton"]},
        lambda: {"displacement": np.array(last["displacement"])},
    )


serve(setup)
