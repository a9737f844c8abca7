"""One linearised step of backward Euler in the manner of Taichi's implicit FEM example, in three ways.

    shipped    conjugate gradients whose product goes over the 12 columns of each cell's stiffness, as the example's
    rewritten  the same with a product by the differential of the deformation gradient
    factored   the example's option of a sparse factorisation, made once

The example's material is corotated with lam = 0 and its matrix leaves the change of the rotation out, so that it is
constant: another system than warpfem's, and an easier one.
"""

import numpy as np
import taichi as ti
from serving import Contender, serve, settled, timed


def setup(problem, options):
    ti.init(arch=ti.cpu, cpu_max_num_threads=options["threads"], offline_cache=False, log_level="error")
    points, cells = problem["points"], problem["cells"].astype(np.int32)
    n, cell_count, dt, way = len(points), len(cells), float(problem["dt"]), options["way"]
    mu = float(problem["E"]) / 2  # nu = 0
    alone = options["threads"] == 1  # a loop told to be serial needs no atomics
    shapes = np.swapaxes(points[cells[:, 1:]] - points[cells[:, :1]], 1, 2)
    volumes, inverses = np.abs(np.linalg.det(shapes)) / 6, np.linalg.inv(shapes)
    masses = np.zeros(n)
    np.add.at(masses, cells, float(problem["density"]) * volumes[:, None] / 4)

    corner = ti.Vector.field(4, ti.i32, shape=cell_count)
    B = ti.Matrix.field(3, 3, ti.f32, shape=cell_count)
    W, m = ti.field(ti.f32, shape=cell_count), ti.field(ti.f32, shape=n)
    x, v, f, b, r, d, q = (ti.Vector.field(3, ti.f32, shape=n) for _ in range(7))
    for target, source in ((corner, cells), (B, inverses), (W, volumes), (m, masses)):
        target.from_numpy(source.astype(np.int32 if source is cells else np.float32))

    @ti.func
    def differences(values: ti.template(), c):
        k = corner[c]
        return ti.Matrix.cols([values[k[i + 1]] - values[k[0]] for i in ti.static(range(3))])

    @ti.kernel
    def forces():
        for i in f:
            f[i] = ti.Vector.zero(ti.f32, 3)
        if ti.static(alone):
            ti.loop_config(serialize=True)
        for c in range(cell_count):
            F = differences(x, c) @ B[c]
            U, _, V = ti.svd(F)
            H = -W[c] * 2 * mu * (F - U @ V.transpose()) @ B[c].transpose()
            for i in ti.static(range(3)):
                part = ti.Vector([H[0, i], H[1, i], H[2, i]])
                f[corner[c][i + 1]] += part
                f[corner[c][0]] -= part

    @ti.kernel
    def product_by_columns(p: ti.template(), out: ti.template()):
        for i in out:
            out[i] = m[i] * p[i]
        if ti.static(alone):
            ti.loop_config(serialize=True)
        for c in range(cell_count):
            k = corner[c]
            for u in range(4):
                for component in range(3):
                    dD = ti.Matrix.zero(ti.f32, 3, 3)
                    if u == 0:
                        for j in range(3):
                            dD[component, j] = -1
                    else:
                        dD[component, u - 1] = 1
                    dH = -W[c] * 2.0 * mu * (dD @ B[c]) @ B[c].transpose()
                    for i in range(3):
                        for j in range(3):
                            out[k[u]][component] -= dt**2 * dH[j, i] * (p[k[i + 1]][j] - p[k[0]][j])

    @ti.kernel
    def product_by_gradient(p: ti.template(), out: ti.template()):
        for i in out:
            out[i] = m[i] * p[i]
        if ti.static(alone):
            ti.loop_config(serialize=True)
        for c in range(cell_count):
            H = dt * dt * 2 * mu * W[c] * (differences(p, c) @ B[c]) @ B[c].transpose()
            for i in ti.static(range(3)):
                part = ti.Vector([H[0, i], H[1, i], H[2, i]])
                out[corner[c][i + 1]] += part
                out[corner[c][0]] -= part

    @ti.kernel
    def combine(out: ti.template(), a: ti.template(), s: ti.f32, c: ti.template()):
        for i in out:
            out[i] = a[i] + s * c[i]

    @ti.kernel
    def dot(a: ti.template(), c: ti.template()) -> ti.f32:
        total = 0.0
        for i in a:
            total += a[i].dot(c[i])
        return total

    @ti.kernel
    def right_side():
        for i in b:
            b[i] = m[i] * v[i] + dt * f[i]

    product = product_by_columns if way == "shipped" else product_by_gradient

    def solve_by_gradients():
        product(v, q)
        combine(r, b, -1.0, q)
        d.copy_from(r)
        first = rho = dot(r, r)
        count = 0
        while count < 1000 and rho > options["tolerance"] ** 2 * first:
            product(d, q)
            alpha = rho / dot(d, q)
            combine(v, v, alpha, d)
            combine(r, r, -alpha, q)
            rho, old = dot(r, r), rho
            combine(d, r, rho / old, d)
            count += 1
        return count

    if way == "factored":
        builder = ti.linalg.SparseMatrixBuilder(3 * n, 3 * n, max_num_triplets=3 * 16 * cell_count + 3 * n)
        gradients = np.concatenate([-inverses.sum(axis=1, keepdims=True), inverses], axis=1)
        scaled = dt * dt * 2 * mu * volumes[:, None, None] * (gradients @ np.swapaxes(gradients, 1, 2))
        stiffness = ti.ndarray(ti.f32, shape=scaled.shape)
        stiffness.from_numpy(scaled.astype(np.float32))

        @ti.kernel
        def fill(A: ti.types.sparse_matrix_builder(), K: ti.types.ndarray()):
            for i in m:
                for j in ti.static(range(3)):
                    A[3 * i + j, 3 * i + j] += m[i]
            for c in corner:
                for i, j, component in ti.static(ti.ndrange(4, 4, 3)):
                    A[3 * corner[c][i] + component, 3 * corner[c][j] + component] += K[c, i, j]

        @ti.kernel
        def flatten(out: ti.types.ndarray()):
            for i in b:
                for j in ti.static(range(3)):
                    out[3 * i + j] = b[i][j]

        @ti.kernel
        def unflatten(values: ti.types.ndarray()):
            for i in v:
                for j in ti.static(range(3)):
                    v[i][j] = values[3 * i + j]

        fill(builder, stiffness)
        matrix = builder.build()
        solver = ti.linalg.SparseSolver(ti.f32, "LLT")
        solver.analyze_pattern(matrix)
        solver.factorize(matrix)
        flat = ti.ndarray(ti.f32, shape=3 * n)

    def solve_by_factor():
        flatten(flat)
        unflatten(solver.solve(flat))
        return 0

    solve = solve_by_factor if way == "factored" else solve_by_gradients
    start = (points + problem["u"]).astype(np.float32)

    def run():
        x.from_numpy(start)
        v.fill(0)
        ti.sync()
        counts = []

        def step():
            forces()
            right_side()
            counts.append(solve())
            combine(x, x, dt, v)
            ti.sync()

        return {"seconds": timed(step), "iterations": counts[0]}

    def outcome():
        """The relative residual of the example's own system, in float64."""
        velocity, right = v.to_numpy().astype(np.float64), dt * f.to_numpy().astype(np.float64)
        gradient = np.einsum("cki,ckj->cij", velocity[cells[:, 1:]] - velocity[cells[:, :1]], inverses)
        parts = dt * dt * 2 * mu * volumes[:, None, None] * np.einsum("cij,ckj->cki", gradient, inverses)
        applied = masses[:, None] * velocity
        np.add.at(applied, cells[:, 1:], parts)
        np.add.at(applied, cells[:, 0], -parts.sum(axis=1))
        return {
            "residual": np.atleast_1d(np.linalg.norm(right - applied) / np.linalg.norm(right)),
            "velocity": velocity,
        }

    return Contender(settled(run), outcome)


serve(setup)
