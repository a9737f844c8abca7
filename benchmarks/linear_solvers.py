"""The linear solvers of warpfem beside each other: where each wins, and how the iterations of multigrid grow.

    python benchmarks/linear_solvers.py [cases] [growth] [--largest UNKNOWNS] [--method NAME ...]

``cases`` solves one linear system to a true residual of 1e-6 for bodies that are easy and hard in different ways, by
each method; ``growth`` a beam that is refined, by multigrid. Both print the time to set up (analysis and factor,
or hierarchy), to solve, and to set up again for a tangent of the same pattern; kernels are compiled beforehand.
Needs ``pip install 'warpfem[solvers]'``.
"""

import argparse
import resource
import time
from collections.abc import Iterator

import numpy as np
import warp as wp

import warpfem as wf
from warpfem.errors import SimulationError
from warpfem.linear import METHODS, LinearSolver, tangent_operator

TOLERANCE = 1e-6


def beam(cells: int, length: float = 8.0, nu: float = 0.3, contrast: float = 1.0, **options) -> wf.Body:
    """A beam 1 m thick, held at its left side, with ``cells`` cells across."""
    mesh = wf.Mesh.box((length, 1.0, 1.0), (round(length * cells), cells, cells))
    middle = mesh.points[mesh.cells].mean(axis=1)
    stiff = (np.floor(middle[:, 0] * cells / 2) % 2) == 0
    E = np.where(stiff, 1e8, 1e8 / contrast) if contrast > 1.0 else 1e8
    return wf.Body("beam", mesh, wf.StableNeoHookean(E=E, nu=nu), density=1000.0, supports=[wf.Pin("left")], **options)


def cases() -> Iterator[tuple[str, wf.Body, float | None]]:
    """Name, body and time step [s], ``None`` without inertia."""
    block = wf.Mesh.box((1, 1, 1), (16, 16, 16))
    yield "block, dt = 5 ms", wf.Body("block", block, wf.StableNeoHookean(E=1e5, nu=0.3)), 5e-3
    yield "block, dt = 1/24 s", wf.Body("block", block, wf.StableNeoHookean(E=1e6, nu=0.3)), 1 / 24
    yield "beam 1:8", beam(8), None
    yield "slender, 1:60", beam(4, 60.0), None
    yield "nu = 0.4999", beam(8, 3.0, nu=0.4999), None
    yield "averaged, nu = 0.4999", beam(8, 3.0, nu=0.4999, element="averaged"), None
    yield "contrast 1e6", beam(8, 3.0, contrast=1e6), None
    yield "beam 1:8, 88k cells", beam(13), None


def measure(name: str, body: wf.Body, dt: float | None, method: str, dtype: str) -> None:
    """Solves for gravity, and prints a line."""
    model = wf.Model(wf.Scene([body], wf.BackwardEuler(), gravity=(0, -9.81, 0)), device="cpu", dtype=dtype)
    operator = tangent_operator(model, "assembled")
    b, x, u = wp.clone(model.static_load), model.zeros(), model.zeros()
    if model.supports is not None:
        model.supports.project(b)
    operator.linearize(u, 0.0 if dt is None else dt**-2, precondition=True)
    solver = LinearSolver(operator, method, static=dt is None)
    seconds = []
    for limit in (1, 20_000):
        start = time.perf_counter()
        try:
            result = solver.solve(b, x, tolerance=TOLERANCE, max_iterations=limit)
        except SimulationError as error:
            print(f"{name:24} {method:20} {error}")
            return
        seconds.append(time.perf_counter() - start)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(
        f"{name:24} {method:20} {dtype} {model.dim * model.point_count:8} unknowns  set-up {seconds[0]:7.3f} s  "
        f"solve {seconds[1]:8.4f} s  {result.iterations:5} iterations  residual {result.residual:.1e}  "
        f"{result.status.name.lower():10} peak {memory / 1e9:.2f} GB",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="*", default=["cases", "growth"], choices=["cases", "growth"])
    parser.add_argument("--largest", type=int, default=400_000, help="unknowns of the finest beam")
    parser.add_argument("--method", action="append", choices=METHODS[1:], help="default: all")
    parser.add_argument("--dtype", default="float64", choices=["float32", "float64"])
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    methods = arguments.method or METHODS[1:]
    for method in methods:
        measure("(compiling)", beam(5), None, method, arguments.dtype)
    if "cases" in arguments.what:
        for name, body, dt in cases():
            for method in methods:
                measure(name, body, dt, method, arguments.dtype)
    if "growth" in arguments.what:
        for cells in (6, 9, 13, 18, 25, 34):
            if 3 * (8 * cells + 1) * (cells + 1) ** 2 <= 1.01 * arguments.largest:
                measure(f"beam, {cells} across", beam(cells), None, "multigrid", arguments.dtype)


if __name__ == "__main__":
    main()
