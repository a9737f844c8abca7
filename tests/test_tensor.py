"""Tensor functions in kernels, against NumPy, for matrices of every kind and size in both precisions."""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp
from helpers import cofactor as reference_cofactor
from helpers import polar_rotation as reference_rotation
from helpers import random_rotation

from warpfem import tensor
from warpfem.dtypes import types

settings = pytest.mark.parametrize(
    ("dim", "dtype"), [(2, "float32"), (2, "float64"), (3, "float32"), (3, "float64")], ids=lambda value: str(value)
)
scales = pytest.mark.parametrize("scale", [1.0, 1e-9, 1e9])


@functools.cache
def kernels(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    matrix, vector, scalar = t.matrix, t.vector, t.scalar
    module = f"test_tensor_{dim}_{dtype}"

    @wp.kernel(module=module, enable_backward=False)
    def svd(
        F: wp.array(dtype=matrix),
        U_out: wp.array(dtype=matrix),
        s_out: wp.array(dtype=vector),
        V_out: wp.array(dtype=matrix),
    ):
        i = wp.tid()
        U, s, V = tensor.signed_svd(F[i])
        U_out[i] = U
        s_out[i] = s
        V_out[i] = V

    @wp.kernel(module=module, enable_backward=False)
    def polar(F: wp.array(dtype=matrix), R_out: wp.array(dtype=matrix)):
        i = wp.tid()
        R_out[i] = tensor.polar_rotation(F[i])

    @wp.kernel(module=module, enable_backward=False)
    def rotation_differential(F: wp.array(dtype=matrix), G: wp.array(dtype=matrix), dR_out: wp.array(dtype=matrix)):
        i = wp.tid()
        dR_out[i] = tensor.rotation_differential(F[i], G[i])

    @wp.kernel(module=module, enable_backward=False)
    def invariants(
        H: wp.array(dtype=matrix),
        volume_out: wp.array(dtype=scalar),
        length_out: wp.array(dtype=scalar),
        distortion_out: wp.array(dtype=scalar),
        cofactor_out: wp.array(dtype=matrix),
        change_out: wp.array(dtype=matrix),
    ):
        i = wp.tid()
        volume_out[i] = tensor.volume_change(H[i])
        length_out[i] = tensor.length_change(H[i])
        distortion_out[i] = tensor.distortion(H[i])
        cofactor_out[i] = tensor.cofactor(H[i])
        change_out[i] = tensor.cofactor_change(H[i])

    @wp.kernel(module=module, enable_backward=False)
    def logarithms(y: wp.array(dtype=scalar), log_out: wp.array(dtype=scalar), deficit_out: wp.array(dtype=scalar)):
        i = wp.tid()
        H = matrix()
        H[0, 0] = y[i]
        log_out[i] = tensor.log_volume_ratio(H)
        deficit_out[i] = tensor.log1p_deficit(y[i])

    rotation = tensor.differentiable_rotation()

    @wp.kernel(module=module)
    def differentiable_rotation(F: wp.array(dtype=matrix), R_out: wp.array(dtype=matrix)):
        i = wp.tid()
        R_out[i] = rotation(F[i])

    return SimpleNamespace(**{name: value for name, value in locals().items() if isinstance(value, wp.Kernel)})


def launch(kernel: wp.Kernel, *inputs: tuple[Any, type], outputs: list[type]) -> list[np.ndarray]:
    """Outputs in float64; they start as NaN, so that nothing unwritten passes."""
    arrays = [wp.array(data, dtype=dtype) for data, dtype in inputs]
    count = len(arrays[0])
    results = [wp.full(count, dtype(np.nan), dtype=dtype) for dtype in outputs]
    wp.launch(kernel, count, inputs=arrays, outputs=results)
    return [result.numpy().astype(np.float64) for result in results]


def matrices(dim: int, dtype: str, scale: float) -> np.ndarray:
    """(n, dim, dim) float64, exact in the precision: random and of every special kind of singular values."""
    rng = np.random.default_rng(5)
    small = 100.0 * types(dim, dtype).epsilon
    stretches = [(1, 1, 1), (1, 1, -1), (2, 1, 1), (2, 2, 1), (2, 1, -1), (1, 0, 0), (1, 1, 0), (0, 0, 0)]
    stretches += [(1, 0.5, small), (1, small, small), (1, 0.5, -small), (1, 1 + small, 0.3), (1, 0.7, small - 0.7)]
    stretches += [(5, 1e-3, 1e-4), (100, 1, -0.01), (3, 2, -1)]
    special = [random_rotation(rng, dim) @ np.diag(s[3 - dim :]) @ random_rotation(rng, dim).T for s in stretches]
    special += [np.diag(s[3 - dim :]).astype(float) for s in stretches]
    special += [np.eye(dim, k=1), np.eye(dim, k=-1), np.fliplr(np.eye(dim)), np.ones((dim, dim))]
    special += [random_rotation(rng, dim) for _ in range(5)]
    result = scale * np.concatenate([special, rng.normal(size=(200, dim, dim))])
    return result.astype(types(dim, dtype).numpy).astype(np.float64)


def check_rotations(R: np.ndarray, epsilon: float) -> None:
    identity = np.broadcast_to(np.eye(R.shape[-1]), R.shape)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), identity, atol=10.0 * epsilon)
    assert (np.linalg.det(R) > 0.0).all()


# ---- singular values


@scales
@settings
def test_signed_svd(dim, dtype, scale):
    t = types(dim, dtype)
    F = matrices(dim, dtype, scale)
    U, s, V = launch(kernels(dim, dtype).svd, (F, t.matrix), outputs=[t.matrix, t.vector, t.matrix])
    check_rotations(U, t.epsilon)
    check_rotations(V, t.epsilon)
    size = np.linalg.norm(F, axis=(1, 2))
    error = np.linalg.norm((U * s[:, None]) @ V.transpose(0, 2, 1) - F, axis=(1, 2))
    assert (error <= 20.0 * t.epsilon * size).all()
    expected = np.linalg.svd(F, compute_uv=False)
    assert (np.abs(np.abs(s) - expected) <= 20.0 * t.epsilon * size[:, None]).all()
    assert (s[:, :-1] >= np.abs(s[:, 1:]) - 20.0 * t.epsilon * size[:, None]).all()
    assert (s[:, :-1] >= 0.0).all()  # only the last takes the sign


# ---- rotation of the polar decomposition


def pair_sums(F: np.ndarray) -> np.ndarray:
    """The least sum of two signed singular values, relative to the largest: where it is 0, R is not unique."""
    s = np.linalg.svd(F, compute_uv=False)
    s[:, -1] *= np.where(np.linalg.det(F) < 0.0, -1.0, 1.0)
    return (s[:, -2] + s[:, -1]) / np.maximum(s[:, 0], np.finfo(float).tiny)


@scales
@settings
def test_polar_rotation(dim, dtype, scale):
    t = types(dim, dtype)
    F = matrices(dim, dtype, scale)
    (R,) = launch(kernels(dim, dtype).polar, (F, t.matrix), outputs=[t.matrix])
    check_rotations(R, t.epsilon)
    expected = np.stack([reference_rotation(f) for f in F])
    size = np.linalg.norm(F, axis=(1, 2))
    S = R.transpose(0, 2, 1) @ F
    assert (np.abs(S - S.transpose(0, 2, 1)).max(axis=(1, 2)) <= 10.0 * t.epsilon * size).all()
    # the closest rotation: no other has a larger tr(R^T F), unique or not
    gap = np.einsum("nij,nij->n", expected - R, F)
    assert (np.abs(gap) <= 20.0 * t.epsilon * size).all()
    unique = pair_sums(F) > 0.0
    error = np.linalg.norm(R - expected, axis=(1, 2))[unique]
    reference_error = 2e-14  # of NumPy's singular vectors, as R^T F shows: more than that of R
    assert (error <= (20.0 * t.epsilon + reference_error) / pair_sums(F)[unique]).all()
    assert unique.sum() > 200


@scales
@settings
def test_rotation_differential(dim, dtype, scale):
    """Against differences of the reference; relative to its size |G| / (s_i + s_j)."""
    t = types(dim, dtype)
    F = matrices(dim, dtype, scale)
    F = F[pair_sums(F) > 0.02]
    G = scale * np.random.default_rng(6).normal(size=F.shape).astype(t.numpy).astype(np.float64)
    (dR,) = launch(kernels(dim, dtype).rotation_differential, (F, t.matrix), (G, t.matrix), outputs=[t.matrix])
    h = 1e-6
    expected = np.stack(
        [(reference_rotation(f + h * g) - reference_rotation(f - h * g)) / (2 * h) for f, g in zip(F, G, strict=True)]
    )
    bound = (np.linalg.norm(G, axis=(1, 2)) / np.linalg.norm(F, 2, axis=(1, 2))) / pair_sums(F)
    tolerance = 40.0 * t.epsilon / pair_sums(F) + 1e-8 + (h * bound) ** 2
    assert (np.linalg.norm(dR - expected, axis=(1, 2)) <= tolerance * bound).all()


def test_rotation_differential_of_a_needle():
    """Stretches of 1e3, 1e-3 and 1e-3 in float64: the two small ones hide in the rounding of float32 alone."""
    t = types(3, "float64")
    F = np.diag([1e3, 1e-3, 1e-3])[None]
    G = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])  # turns the two by 2 / (1e-3 + 1e-3)
    (dR,) = launch(kernels(3, "float64").rotation_differential, (F, t.matrix), (G, t.matrix), outputs=[t.matrix])
    np.testing.assert_allclose(dR, 1e3 * G, rtol=1e-8, atol=1e-8)


@settings
def test_rotation_differential_stays_bounded(dim, dtype):
    """Where R is not unique its rate is cut off, neither infinite nor NaN."""
    t = types(dim, dtype)
    F = matrices(dim, dtype, 1.0)
    F = F[pair_sums(F) < 1e-4]
    assert len(F) > 5
    G = np.random.default_rng(6).normal(size=F.shape)
    (dR,) = launch(kernels(dim, dtype).rotation_differential, (F, t.matrix), (G, t.matrix), outputs=[t.matrix])
    assert np.isfinite(dR).all()


@settings
def test_tape_differentiates_the_rotation(dim, dtype):
    t = types(dim, dtype)
    F = matrices(dim, dtype, 1.0)
    F = F[pair_sums(F) > 0.02]
    G = np.random.default_rng(6).normal(size=F.shape)
    (dR,) = launch(kernels(dim, dtype).rotation_differential, (F, t.matrix), (G, t.matrix), outputs=[t.matrix])
    source = wp.array(F, dtype=t.matrix, requires_grad=True)
    target = wp.zeros(len(F), dtype=t.matrix, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(kernels(dim, dtype).differentiable_rotation, len(F), inputs=[source], outputs=[target])
    tape.backward(grads={target: wp.array(G, dtype=t.matrix)})
    np.testing.assert_array_equal(source.grad.numpy().astype(np.float64), dR)


# ---- invariants


@pytest.mark.parametrize("strain", [1e-7, 1e-4, 0.5])
@settings
def test_invariants_do_not_cancel(dim, dtype, strain):
    t = types(dim, dtype)
    H = strain * np.random.default_rng(9).normal(size=(50, dim, dim))
    H = H.astype(t.numpy).astype(np.float64)
    volume, length, distortion, cofactor, change = launch(
        kernels(dim, dtype).invariants, (H, t.matrix), outputs=[t.scalar, t.scalar, t.scalar, t.matrix, t.matrix]
    )
    # references in extended precision, from F = I + H
    wide = H.astype(np.longdouble)
    F = np.eye(dim, dtype=np.longdouble) + wide
    one = np.longdouble(1.0)
    J = determinant(F)
    squares = (F * F).sum(axis=(1, 2))
    size = np.linalg.norm(H, axis=(1, 2))
    reference_error = 20.0 * np.finfo(np.longdouble).eps
    order_one = 10.0 * t.epsilon * size * (1.0 + size) ** 2 + reference_error
    order_two = 10.0 * t.epsilon * size**2 * (1.0 + size) ** 2 + reference_error
    assert (np.abs(volume - (J - one)) <= order_one).all()
    assert (np.abs(length - (squares - dim)) <= order_one).all()
    assert (np.abs(distortion - (squares - dim - 2 * (J - one))) <= order_two).all()
    embedded = np.zeros((len(H), 3, 3))
    embedded[:, :dim, :dim] = H
    embedded[:, dim:, dim:] = np.eye(3 - dim)
    expected = np.stack([reference_cofactor(A) for A in embedded])[:, :dim, :dim]
    np.testing.assert_allclose(cofactor, expected, atol=float(np.max(order_one)), rtol=0)
    embedded[:, :dim, :dim] += np.eye(dim)
    expected = np.stack([reference_cofactor(A) for A in embedded])[:, :dim, :dim] - np.eye(dim)
    assert (np.abs(change - expected) <= (order_one + 1e-15)[:, None, None]).all()


def determinant(A: np.ndarray) -> np.ndarray:
    """Of (n, d, d), in any precision."""
    if A.shape[-1] == 2:
        return A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    return (np.cross(A[:, 0], A[:, 1]) * A[:, 2]).sum(axis=1)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_logarithm_of_the_volume_ratio(dtype):
    """Everywhere to a few roundings, across the changes of formula at |y| = 0.3."""
    t = types(2, dtype)
    powers = 10.0 ** np.linspace(-12, 0, 200)
    y = np.concatenate([powers, -0.999 * powers, [0.0, 0.3, -0.3, 0.29999, -0.29999, 5.0, 1e4]])
    y = y.astype(t.numpy).astype(np.float64)
    log, deficit = launch(kernels(2, dtype).logarithms, (y, t.scalar), outputs=[t.scalar, t.scalar])
    np.testing.assert_allclose(log, np.log1p(y), rtol=4.0 * t.epsilon)
    wide = y.astype(np.longdouble)
    expected = np.where(np.abs(wide) < 1e-3, series(wide), wide - np.log1p(wide))
    np.testing.assert_allclose(deficit, expected.astype(np.float64), rtol=16.0 * t.epsilon, atol=1e-38)


def series(y: np.ndarray) -> np.ndarray:
    """y - ln(1 + y) for |y| < 1e-3."""
    return sum((-1.0) ** k * y**k / k for k in range(2, 9))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_logarithms_end_at_minus_one(dtype):
    t = types(2, dtype)
    log, deficit = launch(kernels(2, dtype).logarithms, ([-1.0, -1.5], t.scalar), outputs=[t.scalar, t.scalar])
    assert deficit[0] == np.inf
    assert np.isnan([*log, deficit[1]]).all()
