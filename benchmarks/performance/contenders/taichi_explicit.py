"""Steps of symplectic Euler with Taichi, in four ways.

atomic   a kernel over cells adds corner forces to points
serial   the same, told to be serial, which spares the atomics: one thread only
sums     corner forces are written, and summed by a kernel over points
tape     the energy is written and its tape gives the forces
"""

import numpy as np
import taichi as ti
from serving import Contender, serve, timed


def setup(problem, options):
    ti.init(
        arch=ti.cpu, cpu_max_num_threads=options["threads"], default_fp=ti.f32, offline_cache=False, log_level="error"
    )
    points, cells = problem["points"], problem["cells"]
    point_count, cell_count = len(points), len(cells)
    E, nu, density = (float(problem[name]) for name in ("E", "nu", "density"))
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    way, material, steps, dt = options["way"], options["material"], options["steps"], float(problem["dt"])
    tape = way == "tape"

    corner = ti.Vector.field(4, ti.i32, shape=cell_count)
    inverse_shape = ti.Matrix.field(3, 3, ti.f32, shape=cell_count)
    volume = ti.field(ti.f32, shape=cell_count)
    u = ti.Vector.field(3, ti.f32, shape=point_count, needs_grad=tape)
    v = ti.Vector.field(3, ti.f32, shape=point_count)
    f = ti.Vector.field(3, ti.f32, shape=point_count)
    inverse_mass = ti.field(ti.f32, shape=point_count)
    energy = ti.field(ti.f32, shape=(), needs_grad=tape)

    shapes = np.swapaxes(points[cells[:, 1:]] - points[cells[:, :1]], 1, 2)
    volumes = np.abs(np.linalg.det(shapes)) / 6
    masses = np.zeros(point_count)
    np.add.at(masses, cells, density * volumes[:, None] / 4)
    corner.from_numpy(cells.astype(np.int32))
    inverse_shape.from_numpy(np.linalg.inv(shapes).astype(np.float32))
    volume.from_numpy(volumes.astype(np.float32))
    inverse_mass.from_numpy(np.where(problem["fixed"], 0.0, 1.0 / masses).astype(np.float32))

    @ti.func
    def cofactor(F):
        return ti.Matrix(
            [
                [
                    F[(i + 1) % 3, (j + 1) % 3] * F[(i + 2) % 3, (j + 2) % 3]
                    - F[(i + 1) % 3, (j + 2) % 3] * F[(i + 2) % 3, (j + 1) % 3]
                    for j in range(3)
                ]
                for i in range(3)
            ]
        )

    @ti.func
    def first_row_expansion(F, C):
        return F[0, 0] * C[0, 0] + F[0, 1] * C[0, 1] + F[0, 2] * C[0, 2]

    @ti.func
    def deformation_gradient(c):
        k = corner[c]
        H = ti.Matrix.cols([u[k[1]] - u[k[0]], u[k[2]] - u[k[0]], u[k[3]] - u[k[0]]]) @ inverse_shape[c]
        return ti.Matrix.identity(ti.f32, 3) + H

    @ti.func
    def stress(F):
        C = cofactor(F)
        J = first_row_expansion(F, C)
        P = F
        if ti.static(material == "stable_neo_hookean"):
            a, b = ti.static(4 / 3 * mu, lam + 5 / 6 * mu)
            P = a * (1 - 1 / (F.norm_sqr() + 1)) * F + (b * (J - 1) - 0.75 * a) * C
        elif ti.static(material == "neo_hookean"):
            P = mu * F + ((lam * ti.log(J) - mu) / J) * C
        else:
            R, _ = ti.polar_decompose(F)
            P = 2 * mu * (F - R) + lam * (J - 1) * C
        return P

    @ti.func
    def corner_forces(c):
        H = volume[c] * stress(deformation_gradient(c)) @ inverse_shape[c].transpose()
        f1 = -ti.Vector([H[0, 0], H[1, 0], H[2, 0]])
        f2 = -ti.Vector([H[0, 1], H[1, 1], H[2, 1]])
        f3 = -ti.Vector([H[0, 2], H[1, 2], H[2, 2]])
        return -(f1 + f2 + f3), f1, f2, f3

    @ti.kernel
    def add_forces():
        if ti.static(way == "serial"):
            ti.loop_config(serialize=True)
        for c in range(cell_count):
            k = corner[c]
            for i, force in ti.static(enumerate(corner_forces(c))):
                f[k[i]] += force

    if way == "sums":
        part = ti.Vector.field(3, ti.f32, shape=4 * cell_count)
        place = ti.field(ti.i32, shape=4 * cell_count)
        begin = ti.field(ti.i32, shape=point_count + 1)
        place.from_numpy(np.argsort(cells.ravel(), kind="stable").astype(np.int32))
        counts = np.bincount(cells.ravel(), minlength=point_count)
        begin.from_numpy(np.concatenate([[0], np.cumsum(counts)]).astype(np.int32))

        @ti.kernel
        def sum_forces():
            for c in range(cell_count):
                for i, force in ti.static(enumerate(corner_forces(c))):
                    part[4 * c + i] = force
            for i in f:
                total = ti.Vector.zero(ti.f32, 3)
                for q in range(begin[i], begin[i + 1]):
                    total += part[place[q]]
                f[i] = total

    @ti.kernel
    def add_energy():
        for c in corner:
            F = deformation_gradient(c)
            J = F.determinant()
            i_c = (F.transpose() @ F).trace()
            if ti.static(material == "stable_neo_hookean"):
                a, b = ti.static(4 / 3 * mu, lam + 5 / 6 * mu)
                gap = J - 1 - 0.75 * a / b
                energy[None] += volume[c] * (a / 2 * (i_c - 3 - ti.log(i_c + 1)) + b / 2 * gap * gap)
            else:
                energy[None] += volume[c] * (mu / 2 * (i_c - 3) - mu * ti.log(J) + lam / 2 * ti.log(J) ** 2)

    @ti.kernel
    def move():
        for i in u:
            v[i] += dt * inverse_mass[i] * f[i]
            u[i] += dt * v[i]
            f[i] = ti.Vector.zero(ti.f32, 3)

    @ti.kernel
    def move_by_gradient():
        for i in u:
            v[i] -= dt * inverse_mass[i] * u.grad[i]
            u[i] += dt * v[i]

    find_forces = sum_forces if way == "sums" else add_forces

    def hand_step():
        find_forces()
        move()

    def tape_step():
        with ti.ad.Tape(loss=energy):
            add_energy()
        move_by_gradient()

    step = tape_step if tape else hand_step
    start = problem["u"].astype(np.float32)

    def reset():
        u.from_numpy(start)
        v.fill(0)
        f.fill(0)

    reset()
    if tape:
        with ti.ad.Tape(loss=energy):
            add_energy()
        forces = -u.grad.to_numpy().astype(np.float64)
    else:
        find_forces()
        forces = f.to_numpy().astype(np.float64)

    def run():
        reset()
        ti.sync()

        def go():
            for _ in range(steps):
                step()
            ti.sync()

        return {"seconds": timed(go) / steps}

    return Contender(run, lambda: {"forces": forces, "displacement": u.to_numpy().astype(np.float64)})


serve(setup)
