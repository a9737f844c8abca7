"""The model of a body for Newton's solvers."""

import newton
import numpy as np


def build(problem, k_mu, k_lambda, gravity=0.0, coloured=False):
    """The body at its rest shape; fixed points have no mass, which Newton takes for an infinite one."""
    points, cells = problem["points"], problem["cells"]
    builder = newton.ModelBuilder(gravity=(0.0, gravity, 0.0))
    shapes = points[cells[:, 1:]] - points[cells[:, :1]]
    masses = np.zeros(len(points))
    np.add.at(masses, cells, float(problem["density"]) * np.abs(np.linalg.det(shapes))[:, None] / 24)
    masses[problem["fixed"]] = 0.0
    builder.add_particles(pos=points.tolist(), vel=np.zeros_like(points).tolist(), mass=masses.tolist())
    for i, j, k, m in cells.tolist():
        builder.add_tetrahedron(i, j, k, m, k_mu=k_mu, k_lambda=k_lambda, k_damp=0.0)
    if coloured:
        builder.color()
    model = builder.finalize(device="cpu")
    model.particle_grid = None  # no contact between particles
    return model
