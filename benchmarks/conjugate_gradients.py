"""Conjugate gradients of warpfem beside those of ``warp.optim.linear``, for one implicit step of a block.

    python benchmarks/conjugate_gradients.py [--cells N] [--iterations N]

Both solve the same assembled system (float32, block Jacobi) for the same number of iterations, in turn, five
times each; the medians are printed. Kernels are compiled beforehand.
"""

import argparse
import statistics
import time

import warp as wp
from warp.optim.linear import LinearOperator, cg

import warpfem as wf
from warpfem.linear import BlockJacobi, ConjugateGradients, tangent_operator


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=20, help="cells along each edge of the block")
    parser.add_argument("--iterations", type=int, default=20, help="iterations of each solve")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR

    n = arguments.cells
    body = wf.Body("block", wf.Mesh.box((1, 1, 1), (n, n, n)), wf.StableNeoHookean(E=1e5, nu=0.3))
    model = wf.Model(wf.Scene([body], wf.BackwardEuler(), gravity=(0, -9.81, 0)), device="cpu")
    operator = tangent_operator(model, "assembled")
    operator.linearize(model.state().u, mass_weight=1e4, precondition=True)
    b, x = model.dead_load, model.zeros()
    own, jacobi = ConjugateGradients(model), BlockJacobi(operator)

    def multiply(p, y, z, alpha, beta):  # z = alpha A p + beta y, as warp.optim.linear calls it
        operator.apply(p, z)

    def precondition(r, y, z, alpha, beta):
        wp.launch(_multiply_blocks, model.point_count, inputs=[operator.inverse_diagonal, r], outputs=[z])

    shape = (3 * model.point_count,) * 2
    A = LinearOperator(shape, model.types.vector, model.device, multiply)
    M = LinearOperator(shape, model.types.vector, model.device, precondition)

    def solve_own() -> None:
        own.solve(operator, jacobi, b, x, tolerance=1e-30, max_iterations=arguments.iterations)

    def solve_library() -> None:
        x.zero_()
        cg(A, b, x, tol=1e-30, maxiter=arguments.iterations, M=M, check_every=arguments.iterations)

    seconds: dict[str, list[float]] = {"warpfem": [], "warp.optim.linear": []}
    for repeat in range(6):
        for name, solve in (("warpfem", solve_own), ("warp.optim.linear", solve_library)):
            start = time.perf_counter()
            solve()
            if repeat:  # the first compiles
                seconds[name].append(time.perf_counter() - start)
    print(f"{3 * model.point_count} unknowns, {model.cell_count} cells, {arguments.iterations} iterations")
    for name, times in seconds.items():
        print(f"{name:18} {statistics.median(times) / arguments.iterations * 1e3:8.3f} ms an iteration")
    ratio = statistics.median(seconds["warp.optim.linear"]) / statistics.median(seconds["warpfem"])
    print(f"ratio {ratio:.1f}")


@wp.kernel(enable_backward=False)
def _multiply_blocks(
    blocks: wp.array(dtype=wp.mat33f), p: wp.array(dtype=wp.vec3f), product_out: wp.array(dtype=wp.vec3f)
):
    i = wp.tid()
    product_out[i] = blocks[i] * p[i]


if __name__ == "__main__":
    main()
