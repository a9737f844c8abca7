"""Linear elasticity of a beam under its weight with scikit-fem: assembly, and its usual sparse LU or its gradients."""

import numpy as np
import skfem
from serving import Contender, serve, timed
from skfem.models.elasticity import lame_parameters, linear_elasticity


def setup(problem, options):
    mesh = skfem.MeshTet(problem["points"].T.copy(), problem["cells"].T.copy())
    density, gravity = float(problem["density"]), float(problem["gravity"])
    fixed = np.flatnonzero(problem["fixed"])
    last = {}

    @skfem.LinearForm
    def weight(v, w):
        return density * gravity * v[1]

    def solve():
        basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP1()))
        form = linear_elasticity(*lame_parameters(float(problem["E"]), float(problem["nu"])))
        held = basis.nodal_dofs[:, fixed].ravel()
        condensed = skfem.condense(form.assemble(basis), weight.assemble(basis), D=held)
        if options["solver"] == "direct":
            solution = skfem.solve(*condensed)
        else:
            gradients = skfem.solver_iter_pcg(rtol=options["tolerance"], maxiter=100_000)
            solution = skfem.solve(*condensed, solver=gradients)
        last["displacement"] = solution[basis.nodal_dofs].T

    return Contender(lambda: {"seconds": timed(solve)}, lambda: {"displacement": last["displacement"]})


serve(setup)
