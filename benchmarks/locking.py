"""Which linear element does not lock as nu nears 0.5, measured before and after it was built.

    python benchmarks/locking.py [cook cantilever block modes squash built] [--picture FILE]

The first four solve linear elasticity in SciPy, which wants ``pip install -e '.[bench]'``:

- ``cook``: Cook's membrane in plane strain, deflection of its upper right corner;
- ``cantilever``: 4:1:1, clamped, deflection of its end under its weight;
- ``block``: pressed by 1 % between rough plates, its reaction, in 2D and 3D;
- ``modes``: the lowest eigenvalues of a free block over those of quadratic cells with a mean dilatation: soft modes
  that no solid has would be far below 1.

For each element, mesh and number of unknowns they print the error in per cent of a converged reference (quadratic cells
with one mean dilatation a cell), and in brackets the roughness: the part of the cells' pressures that their mean over
the cells about each point takes away. ``--picture`` draws the pressures of the membrane and the block.

``squash`` compresses blocks of stable Neo-Hookean solid in warpfem, with and without what averaged cells keep of lam.
``built`` solves the cantilever in warpfem with each element.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from unittest import mock

import numpy as np
import scipy.sparse as sparse
from scipy.linalg import eigh
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay

import warpfem as wf
from warpfem import averaged
from warpfem.patches import cell_patches

YOUNG = 1.0


class Discretisation:
    """Shape function gradients at the quadrature points of a mesh, and the matrices made of them.

    Attributes:
        mesh: the mesh, linear or quadratic.
        cell: the cell of each quadrature point, (q,).
        nodes: the points of that cell, (q, k).
        gradients: of their shape functions, (q, k, dim) [1/m].
        volume: part of the rest volume, (q,).
    """

    def __init__(self, mesh: wf.Mesh) -> None:
        own = mesh.shape
        self.mesh = mesh
        self.cell = np.repeat(np.arange(mesh.cell_count), own.quadrature_count)
        self.nodes = mesh.cells[self.cell]
        B = mesh.inverse_shape_matrices.reshape(-1, own.quadrature_count, mesh.dim, mesh.dim)
        self.gradients = np.einsum("qak,cqkj->cqaj", own.quadrature_gradients, B).reshape(len(self.cell), -1, mesh.dim)
        self.volume = mesh.quadrature_volumes

    def divergence(self) -> sparse.csr_matrix:
        """From displacements (n dim,) to tr eps (q,)."""
        q, k, d = self.gradients.shape
        columns = self.nodes[:, :, None] * d + np.arange(d)
        rows = np.repeat(np.arange(q), k * d)
        return sparse.csr_matrix((self.gradients.ravel(), (rows, columns.ravel())), (q, self.mesh.points.size))

    def shear_stiffness(self, mu: float) -> sparse.csr_matrix:
        """The stiffness of 2 mu eps : eps / 2."""
        q, k, d = self.gradients.shape
        g, w = self.gradients, mu * self.volume
        K = np.einsum("q,qai,qbi,jl->qajbl", w, g, g, np.eye(d)) + np.einsum("q,qal,qbj->qajbl", w, g, g)
        places = (self.nodes[:, :, None] * d + np.arange(d)).reshape(q, -1)
        rows, columns = np.repeat(places, k * d, axis=1), np.tile(places, (1, k * d))
        return sparse.csr_matrix((K.ravel(), (rows.ravel(), columns.ravel())), (self.mesh.points.size,) * 2)


# ---- groups: matrices (groups, quadrature points) of the shares that each group has in a quadrature point


def by_number(group: np.ndarray) -> sparse.csr_matrix:
    return sparse.csr_matrix((np.ones(len(group)), (group, np.arange(len(group)))))


def alone(disc: Discretisation) -> sparse.csr_matrix:
    return by_number(np.arange(len(disc.cell)))


def cells(disc: Discretisation) -> sparse.csr_matrix:
    return by_number(disc.cell)


def points(disc: Discretisation) -> sparse.csr_matrix:
    m, k = disc.mesh.cells.shape
    return sparse.csr_matrix((np.full(m * k, 1.0 / k), (disc.mesh.cells.ravel(), np.repeat(np.arange(m), k))))


def patches(disc: Discretisation) -> sparse.csr_matrix:
    return by_number(cell_patches(disc.mesh, np.ones(disc.mesh.cell_count)))


@dataclass
class Element:
    """A candidate.

    Attributes:
        name: what it is.
        groups: over what lam resists the mean of the volumetric strain.
        kept: from (lam, mu) to the part of lam that each quadrature point keeps.
        order: of the shape functions.
    """

    name: str
    groups: Callable[[Discretisation], sparse.csr_matrix]
    kept: Callable[[float, float], float] = lambda lam, mu: 0.0
    order: int = 1


ELEMENTS = (
    Element("linear", alone),
    Element("means about points", points),
    Element("same, keeping 5 %", points, lambda lam, mu: 0.05 * min(lam, 25.0 * mu)),  # Puso and Solberg 2006
    Element("patches", patches),
    Element("patches, as built", patches, lambda lam, mu: lam * mu / (lam + mu)),
    Element("quadratic", alone, order=2),
)
REFERENCE = Element("quadratic, mean dilatation", cells, order=2)


class Solid:
    """A linear elastic solid of E = 1 Pa."""

    def __init__(self, element: Element, mesh: wf.Mesh, nu: float) -> None:
        self.mesh = mesh.quadratic() if element.order == 2 else mesh
        mu, lam = YOUNG / (2.0 * (1.0 + nu)), YOUNG * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
        disc = Discretisation(self.mesh)
        self._kept = element.kept(lam, mu)
        self._averaged = lam - self._kept
        self._disc, self._divergence, self._groups = disc, disc.divergence(), element.groups(disc)
        weighted = self._groups @ sparse.diags(disc.volume)
        volume = np.asarray(weighted.sum(axis=1)).ravel()
        self._mean = sparse.diags(1.0 / volume) @ weighted @ self._divergence
        own = self._kept * (self._divergence.T @ sparse.diags(disc.volume) @ self._divergence)
        shared = self._averaged * (self._mean.T @ sparse.diags(volume) @ self._mean)
        self.K = (disc.shear_stiffness(mu) + own + shared).tocsc()

    def solve(self, held: np.ndarray, values: np.ndarray, load: np.ndarray) -> np.ndarray:
        """Displacements (n dim,), with those of ``held`` given."""
        u = np.zeros(self.mesh.points.size)
        u[held] = values
        free = np.setdiff1d(np.arange(len(u)), held)
        factors = splu(self.K[free][:, free], permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0)
        u[free] = factors.solve((load - self.K @ u)[free])
        return u

    def cell_pressures(self, u: np.ndarray) -> np.ndarray:
        """lam tr eps, its mean in each cell."""
        p = self._averaged * (self._groups.T @ (self._mean @ u)) + self._kept * (self._divergence @ u)
        return np.bincount(self._disc.cell, p * self._disc.volume) / self.mesh.cell_volumes

    def roughness(self, u: np.ndarray) -> float:
        """The part of the pressures that the means over the cells about each point take away."""
        p, V, mesh = self.cell_pressures(u), self.mesh.cell_volumes, self.mesh
        corners = mesh.cells[:, : mesh.dim + 1]
        weights = np.repeat(V, mesh.dim + 1)
        count = np.bincount(corners.ravel(), weights)
        about = np.bincount(corners.ravel(), weights * np.repeat(p, mesh.dim + 1)) / np.where(count > 0.0, count, 1.0)
        return float(np.sqrt((V * (p - about[corners].mean(axis=1)) ** 2).sum() / (V * p**2).sum()))


# ---- meshes and problems


def jittered(mesh: wf.Mesh, size: float) -> wf.Mesh:
    """The mesh with its inner points off the grid."""
    moved = mesh.points.copy()
    inner = np.setdiff1d(np.arange(mesh.point_count), mesh.boundary_points)
    moved[inner] += size * np.random.default_rng(0).uniform(-1, 1, (len(inner), mesh.dim))
    return wf.Mesh(moved, mesh.cells)


def square(n: int, kind: str) -> wf.Mesh:
    mesh = wf.Mesh.rectangle((1, 1), (n, n))
    if kind == "regular":
        return mesh
    mesh = jittered(mesh, 0.3 / n)
    return mesh if kind == "jittered" else wf.Mesh.repaired(mesh.points, Delaunay(mesh.points).simplices)


def box(size: tuple, counts: tuple, kind: str) -> wf.Mesh:
    mesh = wf.Mesh.box(size, counts, split=5 if kind == "five a cube" else 6)
    return jittered(mesh, 0.2 * size[0] / counts[0]) if kind == "jittered" else mesh


def every(mask: np.ndarray, dim: int) -> np.ndarray:
    """The components of the points of a mask."""
    return np.flatnonzero(np.repeat(mask, dim))


def cook(element: Element, n: int, nu: float, kind: str) -> tuple[Solid, np.ndarray, float]:
    """48 wide, 44 high at the clamped left and 16 at the right, where a unit force acts upwards, evenly spread."""
    unit = square(n, kind)
    x, y = unit.points.T
    solid = Solid(element, wf.Mesh(np.stack([48 * x, 44 * x + y * (44 - 28 * x)], axis=1), unit.cells), nu)
    mesh = solid.mesh.with_point_set("right", lambda x: x[:, 0] > 48 - 1e-9)
    load = np.zeros_like(mesh.points)
    faces = mesh.select_faces("right")
    np.add.at(load[:, 1], mesh.boundary_faces[faces], mesh.boundary_face_shares[faces] / 16.0)
    u = solid.solve(every(mesh.points[:, 0] < 1e-9, 2), 0.0, load.ravel())
    return solid, u, u[2 * np.argmax(mesh.points.sum(axis=1)) + 1]


def cantilever(element: Element, n: int, nu: float, kind: str) -> tuple[Solid, np.ndarray, float]:
    """Clamped at x = 0, rho g = 1e-3."""
    solid = Solid(element, box((4, 1, 1), (4 * n, n, n), kind), nu)
    mesh = solid.mesh
    load = np.zeros_like(mesh.points)
    values = mesh.shape.values(mesh.shape.quadrature_places)
    volumes = mesh.quadrature_volumes.reshape(mesh.cell_count, -1)
    np.add.at(load[:, 1], mesh.cells, -1e-3 * volumes @ values)
    u = solid.solve(every(mesh.points[:, 0] < 1e-9, 3), 0.0, load.ravel())
    return solid, u, u[1::3][mesh.points[:, 0] > 4 - 1e-9].mean()


def block(element: Element, n: int, nu: float, kind: str, dim: int) -> tuple[Solid, np.ndarray, float]:
    """A unit block, its top moved down by 1 %."""
    solid = Solid(element, square(n, kind) if dim == 2 else box((1, 1, 1), (n, n, n), kind), nu)
    x = solid.mesh.points
    top = x[:, 1] > 1 - 1e-9
    held = every(top | (x[:, 1] < 1e-9), dim)
    values = np.zeros_like(x)
    values[top, 1] = -0.01
    u = solid.solve(held, values.ravel()[held], np.zeros(x.size))
    return solid, u, -(solid.K @ u)[1::dim][top].sum()


def block_2d(element: Element, n: int, nu: float, kind: str) -> tuple[Solid, np.ndarray, float]:
    return block(element, n, nu, kind, 2)


def block_3d(element: Element, n: int, nu: float, kind: str) -> tuple[Solid, np.ndarray, float]:
    return block(element, n, nu, kind, 3)


def modes(element: Element, n: int, nu: float, kind: str, dim: int, count: int = 10) -> np.ndarray:
    """The lowest eigenvalues of a free unit block of rho = 1, without the rigid motions."""
    solid = Solid(element, square(n, kind) if dim == 2 else box((1, 1, 1), (n, n, n), kind), nu)
    mesh, rigid = solid.mesh, dim * (dim + 1) // 2
    mass = np.bincount(mesh.cells.ravel(), np.outer(mesh.cell_volumes, mesh.shape.mass_shares).ravel())
    scale = 1.0 / np.sqrt(np.repeat(mass, dim))
    K = solid.K.toarray() * scale[:, None] * scale
    return eigh(K, eigvals_only=True, subset_by_index=[0, rigid + count - 1])[rigid:]


# ---- tables

PLANE, SPACE = ("regular", "jittered", "Delaunay"), ("five a cube", "six a cube", "jittered")
PROBLEMS = {
    "cook": [(cook, (8, 16, 32), 64, (0.3, 0.4999, 0.49999), PLANE)],
    "cantilever": [(cantilever, (2, 4, 6), 4, (0.3, 0.4999), SPACE)],
    "block": [(block_2d, (8, 16, 32), 64, (0.4999,), PLANE), (block_3d, (4, 8), 5, (0.4999,), SPACE)],
}


def table(problem: Callable, sizes: tuple, finest: int, nu: float, kind: str) -> None:
    _, _, expected = problem(REFERENCE, finest, nu, "regular" if problem in (cook, block_2d) else "six a cube")
    print(f"\n{problem.__name__}, nu = {nu}, {kind} mesh: error in %, [roughness of the pressure]; {expected:.5g}")
    for element in ELEMENTS:
        row = []
        for n in sizes:
            solid, u, answer = problem(element, n // element.order, nu, kind)
            error = 100.0 * (answer / expected - 1.0)
            row.append(f"{len(u):6d}: {error:8.2f} [{solid.roughness(u):.3f}]")
        print(f"  {element.name:20}", "  ".join(row), flush=True)


def mode_table(nu: float = 0.4999) -> None:
    for dim, n, kinds in ((2, 12, PLANE), (3, 4, SPACE)):
        expected = modes(REFERENCE, {2: 20, 3: 4}[dim], nu, kinds[0], dim)
        for kind in kinds:
            print(f"\nlowest eigenvalues, {dim}D, nu = {nu}, {kind} mesh, over {np.round(expected, 2)}")
            for element in ELEMENTS:
                own = modes(element, n // element.order, nu, kind, dim)
                print(f"  {element.name:20}", np.round(own / expected, 2), flush=True)


def keep_nothing(body: wf.Body) -> tuple[np.ndarray, np.ndarray]:
    lam = np.full(body.mesh.cell_count, body.material.lam)
    return np.zeros_like(lam), lam


def squash_table() -> None:
    print("\nsquashed between rough plates: reaction [N], J of the cells: least, 5 %, 95 %, most; Newton iterations")
    for dim, n, amount, nu in ((2, 20, 0.2, 0.499), (3, 4, 0.3, 0.49), (3, 8, 0.3, 0.49), (3, 4, 0.5, 0.49)):
        print(f"{dim}D, {n} cubes across, by {amount:.0%}, nu = {nu}")
        for element in ("linear", "averaged", "averaged, keeping none", "quadratic"):
            name, _, variant = element.partition(", ")
            with mock.patch.object(averaged, "_moduli", keep_nothing if variant else averaged._moduli):
                print(
                    f"  {element:24}", squash(dim, n if name != "quadratic" else n // 2, amount, nu, name), flush=True
                )


def squash(dim: int, n: int, amount: float, nu: float, element: str) -> str:
    mesh = wf.Mesh.rectangle((1, 1), (n, n)) if dim == 2 else wf.Mesh.box((1, 1, 1), (n, n, n), split=6)
    down = np.eye(dim)[1] * amount
    supports = [wf.Pin("bottom"), wf.PrescribedMotion("top", lambda rest, time: rest - time * down)]
    body = wf.Body("block", mesh, wf.StableNeoHookean(1e6, nu), 100.0, supports, element=element)
    scene = wf.Scene([body], wf.BackwardEuler(), damping=2.0)
    model = wf.Model(scene, dtype="float64", device="cpu")
    state, stepper = model.state(), scene.solver.stepper(model)
    iterations = sum(stepper.step(state, 0.2).newton_iterations for _ in range(5))
    J, _ = model.diagnostics(state)
    reaction = model.internal_force(state)[model.rest_points[:, 1] > 1 - 1e-9, 1].sum()
    spread = " ".join(f"{value:6.3f}" for value in np.percentile(J, (0, 5, 95, 100)))
    return f"{reaction:.4g}  {spread}  {iterations}"


def built_table() -> None:
    print("\ncantilever in warpfem, six jittered cells a cube, float64: unknowns, error in %, seconds, CG iterations")
    for nu in (0.3, 0.49, 0.499):
        _, _, expected = cantilever(REFERENCE, 4, nu, "six a cube")
        for element, sizes in (("linear", (4, 6)), ("averaged", (4, 6)), ("quadratic", (2, 3))):
            row = []
            for n in sizes:
                mesh = box((4, 1, 1), (4 * n, n, n), "jittered").with_point_set("left", lambda x: x[:, 0] < 1e-9)
                material = wf.LinearElasticity(1e6, nu)
                body = wf.Body("beam", mesh, material, 1.0, supports=[wf.Pin("left")], element=element)
                model = wf.Model(
                    wf.Scene([body], wf.BackwardEuler(), gravity=(0, -1e3, 0)), dtype="float64", device="cpu"
                )
                state = model.state()
                start = time.perf_counter()
                report = wf.StaticEquilibrium(tolerance=1e-4).solve(model, state)
                seconds = time.perf_counter() - start
                answer = state.displacement[model.rest_points[:, 0] > 4 - 1e-9, 1].mean()
                error = 100.0 * (answer / expected - 1.0)
                row.append(f"{model.rest_points.size:6d} {error:7.2f} {seconds:6.2f} s {report.cg_iterations:6d}")
            print(f"  nu = {nu:<7} {element:10}", "  |  ".join(row), flush=True)


def draw(path: str, nu: float = 0.4999) -> None:
    """The pressures in Delaunay meshes of the membrane and the block."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    _, axes = pyplot.subplots(2, 4, figsize=(18, 9))
    shown = [
        element for element in ELEMENTS if element.name in ("means about points", "patches, as built", "quadratic")
    ]
    for problem, own in ((cook, axes[0]), (block_2d, axes[1])):
        for axis, element in zip(own, [ELEMENTS[0], *shown], strict=True):
            solid, u, _ = problem(element, 16 // element.order, nu, "Delaunay")
            p, mesh = solid.cell_pressures(u), solid.mesh
            most = float(np.percentile(np.abs(p), 97))
            axis.tripcolor(*mesh.points.T, mesh.cells[:, :3], facecolors=p, vmin=-most, vmax=most, cmap="RdBu")
            axis.set_title(element.name)
            axis.set_aspect("equal")
    pyplot.savefig(path, dpi=60)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="*", default=[*PROBLEMS, "modes", "squash", "built"], help="all without it")
    parser.add_argument("--picture", help="file for a picture of the pressures")
    arguments = parser.parse_args()
    for name in arguments.what:
        for problem, sizes, finest, nus, kinds in PROBLEMS.get(name, []):
            for nu in nus:
                for kind in kinds:
                    table(problem, sizes, finest, nu, kind)
        if name == "modes":
            mode_table()
        if name == "squash":
            squash_table()
        if name == "built":
            built_table()
    if arguments.picture:
        draw(arguments.picture)


if __name__ == "__main__":
    main()
