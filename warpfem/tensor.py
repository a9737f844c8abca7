"""Tensor algebra in kernels, for 2x2 and 3x3 matrices of either precision.

H is the displacement gradient, F = I + H the deformation gradient, J = det F. The functions of H avoid the
cancellation that the textbook forms in F suffer near rest (Shakeri, Brown et al. 2024).
"""

import functools
from typing import Any

import warp as wp

mat22 = wp.types.matrix(shape=(2, 2), dtype=wp.Float)
mat33 = wp.types.matrix(shape=(3, 3), dtype=wp.Float)


@wp.func
def identity_like(A: mat22):
    one = A.dtype(1.0)
    zero = A.dtype(0.0)
    return wp.matrix_from_rows(wp.vector(one, zero), wp.vector(zero, one))


@wp.func
def identity_like(A: mat33):  # noqa: F811
    one = A.dtype(1.0)
    zero = A.dtype(0.0)
    return wp.matrix_from_rows(wp.vector(one, zero, zero), wp.vector(zero, one, zero), wp.vector(zero, zero, one))


@wp.func
def plus_diagonal(A: mat22, c: Any):
    """A + c I; the product would cost more: the compiler may not take c times 0 as 0."""
    return wp.matrix_from_rows(wp.vector(A[0, 0] + c, A[0, 1]), wp.vector(A[1, 0], A[1, 1] + c))


@wp.func
def plus_diagonal(A: mat33, c: Any):  # noqa: F811
    return wp.matrix_from_rows(
        wp.vector(A[0, 0] + c, A[0, 1], A[0, 2]),
        wp.vector(A[1, 0], A[1, 1] + c, A[1, 2]),
        wp.vector(A[2, 0], A[2, 1], A[2, 2] + c),
    )


@wp.func
def deformation_gradient(H: Any):
    """F = I + H."""
    return plus_diagonal(H, H.dtype(1.0))


@wp.func
def symmetric_part(A: Any):
    return A.dtype(0.5) * (A + wp.transpose(A))


@wp.func
def select(condition: bool, A: mat22, B: mat22):
    """A if the condition holds, else B, chosen entry by entry: without a branch, and nothing is overwritten, which
    Warp's reverse mode would not undo."""
    return wp.matrix_from_rows(
        wp.vector(wp.where(condition, A[0, 0], B[0, 0]), wp.where(condition, A[0, 1], B[0, 1])),
        wp.vector(wp.where(condition, A[1, 0], B[1, 0]), wp.where(condition, A[1, 1], B[1, 1])),
    )


@wp.func
def select(condition: bool, A: mat33, B: mat33):  # noqa: F811
    return wp.matrix_from_rows(
        wp.vector(
            wp.where(condition, A[0, 0], B[0, 0]),
            wp.where(condition, A[0, 1], B[0, 1]),
            wp.where(condition, A[0, 2], B[0, 2]),
        ),
        wp.vector(
            wp.where(condition, A[1, 0], B[1, 0]),
            wp.where(condition, A[1, 1], B[1, 1]),
            wp.where(condition, A[1, 2], B[1, 2]),
        ),
        wp.vector(
            wp.where(condition, A[2, 0], B[2, 0]),
            wp.where(condition, A[2, 1], B[2, 1]),
            wp.where(condition, A[2, 2], B[2, 2]),
        ),
    )


@wp.func
def cofactor(A: mat22):
    """cof A = d(det A)/dA, defined for every A."""
    return wp.matrix_from_rows(wp.vector(A[1, 1], -A[1, 0]), wp.vector(-A[0, 1], A[0, 0]))


@wp.func
def cofactor(A: mat33):  # noqa: F811
    r0 = wp.vector(A[0, 0], A[0, 1], A[0, 2])
    r1 = wp.vector(A[1, 0], A[1, 1], A[1, 2])
    r2 = wp.vector(A[2, 0], A[2, 1], A[2, 2])
    return wp.matrix_from_rows(wp.cross(r1, r2), wp.cross(r2, r0), wp.cross(r0, r1))


@wp.func
def cofactor_differential(A: mat22, dA: mat22):
    """d(cof A) for the change dA of A."""
    return cofactor(dA)


@wp.func
def cofactor_differential(A: mat33, dA: mat33):  # noqa: F811
    r0 = wp.vector(A[0, 0], A[0, 1], A[0, 2])
    r1 = wp.vector(A[1, 0], A[1, 1], A[1, 2])
    r2 = wp.vector(A[2, 0], A[2, 1], A[2, 2])
    d0 = wp.vector(dA[0, 0], dA[0, 1], dA[0, 2])
    d1 = wp.vector(dA[1, 0], dA[1, 1], dA[1, 2])
    d2 = wp.vector(dA[2, 0], dA[2, 1], dA[2, 2])
    return wp.matrix_from_rows(
        wp.cross(d1, r2) + wp.cross(r1, d2),
        wp.cross(d2, r0) + wp.cross(r2, d0),
        wp.cross(d0, r1) + wp.cross(r0, d1),
    )


@wp.func
def volume_change(H: mat22):
    """J - 1."""
    return H[0, 0] + (H.dtype(1.0) + H[0, 0]) * H[1, 1] - H[0, 1] * H[1, 0]


@wp.func
def volume_change(H: mat33):  # noqa: F811
    """J - 1, expanded by the first row of F, with the cofactors' changes."""
    change = cofactor_change(H)
    return H[0, 0] + (H.dtype(1.0) + H[0, 0]) * change[0, 0] + (H[0, 1] * change[0, 1] + H[0, 2] * change[0, 2])


@wp.func
def second_invariant(H: mat33):
    """I2(H) = sum of the principal 2x2 minors."""
    return (
        (H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0])
        + (H[1, 1] * H[2, 2] - H[1, 2] * H[2, 1])
        + (H[0, 0] * H[2, 2] - H[0, 2] * H[2, 0])
    )


@wp.func
def length_change(H: Any):
    """I_C - d = tr(F^T F) - d = 2 tr H + |H|^2."""
    return H.dtype(2.0) * wp.trace(H) + wp.ddot(H, H)


@wp.func
def distortion(H: mat22):
    """I_C - d - 2 (J - 1), of second order in H."""
    return wp.ddot(H, H) - H.dtype(2.0) * (H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0])


@wp.func
def distortion(H: mat33):  # noqa: F811
    return wp.ddot(H, H) - H.dtype(2.0) * (second_invariant(H) + wp.determinant(H))


@wp.func
def cofactor_change(H: mat22):
    """cof F - I."""
    return cofactor(H)


@wp.func
def cofactor_change(H: mat33):  # noqa: F811
    """cof F - I: minors of I + H, less 1 in the diagonal, with what cancels left out."""
    one = H.dtype(1.0)
    a = one + H[0, 0]
    b = one + H[1, 1]
    c = one + H[2, 2]
    return wp.matrix_from_rows(
        wp.vector(
            H[1, 1] + b * H[2, 2] - H[1, 2] * H[2, 1],
            H[1, 2] * H[2, 0] - c * H[1, 0],
            H[1, 0] * H[2, 1] - b * H[2, 0],
        ),
        wp.vector(
            H[0, 2] * H[2, 1] - c * H[0, 1],
            H[2, 2] + c * H[0, 0] - H[0, 2] * H[2, 0],
            H[0, 1] * H[2, 0] - a * H[2, 1],
        ),
        wp.vector(
            H[0, 1] * H[1, 2] - b * H[0, 2],
            H[0, 2] * H[1, 0] - a * H[1, 2],
            H[0, 0] + a * H[1, 1] - H[0, 1] * H[1, 0],
        ),
    )


@wp.func
def _atanh_series(w: Any):
    """(atanh z - z) / z^3 for w = z^2 < 0.032."""
    one = type(w)(1.0)  # Warp would divide literals, 1.0 / 17.0, in float32
    series = one / type(w)(19.0)
    series = series * w + one / type(w)(17.0)
    series = series * w + one / type(w)(15.0)
    series = series * w + one / type(w)(13.0)
    series = series * w + one / type(w)(11.0)
    series = series * w + one / type(w)(9.0)
    series = series * w + one / type(w)(7.0)
    series = series * w + one / type(w)(5.0)
    series = series * w + one / type(w)(3.0)
    return series


@wp.func
def log1p_deficit(y: Any):
    """y - ln(1 + y) without cancellation; NaN for y < -1.

    With z = y / (2 + y), ln(1 + y) = 2 atanh z, so that y - ln(1 + y) = y z - 2 (z^3/3 + z^5/5 + ...).
    """
    if wp.abs(y) > type(y)(0.3):
        return y - wp.log(type(y)(1.0) + y)
    z = y / (type(y)(2.0) + y)
    w = z * z
    return y * z - type(y)(2.0) * z * w * _atanh_series(w)


@wp.func
def volume_ratio(H: Any):
    """J = det(I + H): from J - 1 near rest, from F under compression, where J - 1 would keep no digits of J."""
    j = volume_change(H)
    return wp.where(j < H.dtype(-0.5), wp.determinant(deformation_gradient(H)), H.dtype(1.0) + j)


@wp.func
def _binary_exponent(x: wp.float32):
    """The power e of 2 that brings x > 0 to [sqrt(1/2), sqrt(2)], and 2^-e."""
    e = (wp.cast(x, wp.int32) - 0x3F3504F3) >> 23
    return wp.float32(e), wp.cast((127 - e) << 23, wp.float32)


@wp.func
def _binary_exponent(x: wp.float64):
    e = (wp.cast(x, wp.int64) - wp.int64(0x3FE6A09E667F3BCD)) >> wp.int64(52)
    return wp.float64(e), wp.cast((wp.int64(1023) - e) << wp.int64(52), wp.float64)


@wp.func
def log_volume_ratio(H: Any):
    """ln J, accurate near rest and under compression; not a number for J <= 0.

    With J = 2^e (1 + y), ln J = e ln 2 + 2 atanh z, z = y / (2 + y), |z| < 0.18: without branches or calls, so that the
    compiler can take several at a time.
    """
    one = H.dtype(1.0)
    j = volume_change(H)
    J = volume_ratio(H)
    e, scale = _binary_exponent(J)
    near = wp.abs(j) < H.dtype(0.3)
    y = wp.where(near, j, J * scale - one)
    z = y / (H.dtype(2.0) + y)
    w = z * z
    value = wp.where(near, H.dtype(0.0), e) * H.dtype(0.6931471805599453) + H.dtype(2.0) * z * (
        one + w * _atanh_series(w)
    )
    return wp.where(J > H.dtype(0.0), value, H.dtype(wp.nan))


@wp.func
def embed(H: mat22):
    """Plane strain: the 3x3 displacement gradient diag(H, 0)."""
    zero = H.dtype(0.0)
    return wp.matrix_from_rows(
        wp.vector(H[0, 0], H[0, 1], zero), wp.vector(H[1, 0], H[1, 1], zero), wp.vector(zero, zero, zero)
    )


@wp.func
def embed(H: mat33):  # noqa: F811
    return H


@wp.func
def in_plane(A: mat33, like: mat22):
    """The part of a 3x3 matrix that a body of the dimension of ``like`` feels."""
    return wp.matrix_from_rows(wp.vector(A[0, 0], A[0, 1]), wp.vector(A[1, 0], A[1, 1]))


@wp.func
def in_plane(A: mat33, like: mat33):  # noqa: F811
    return A


@wp.func
def is_positive_definite(A: mat22):
    """Whether a symmetric matrix is positive definite (Sylvester's criterion)."""
    return A[0, 0] > A.dtype(0.0) and wp.determinant(A) > A.dtype(0.0)


@wp.func
def is_positive_definite(A: mat33):  # noqa: F811
    zero = A.dtype(0.0)
    minor = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    return A[0, 0] > zero and minor > zero and wp.determinant(A) > zero


# --- singular values -------------------------------------------------------------------------------------


@wp.func
def _squared_epsilon(like: wp.float32):
    return wp.float32(1.0e-15)


@wp.func
def _squared_epsilon(like: wp.float64):
    return wp.float64(1.0e-33)


@wp.func
def _orthogonal(a: Any, b: Any):
    """Whether a and b are orthogonal to rounding."""
    gamma = wp.dot(a, b)
    return gamma * gamma <= _squared_epsilon(gamma) * wp.dot(a, a) * wp.dot(b, b)


@wp.func
def _orthogonalize(a: Any, b: Any, v: Any, w: Any):
    """Rotates the columns (a, b) of a matrix to be orthogonal, and (v, w) with them (one Jacobi rotation)."""
    alpha = wp.dot(a, a)
    beta = wp.dot(b, b)
    gamma = wp.dot(a, b)
    one = type(gamma)(1.0)
    c = one
    s = type(gamma)(0.0)
    if not _orthogonal(a, b):
        zeta = (beta - alpha) / (type(gamma)(2.0) * gamma)
        if wp.abs(zeta) < type(gamma)(1.0e18):
            t = one / (wp.abs(zeta) + wp.sqrt(one + zeta * zeta))
            if zeta < type(gamma)(0.0):
                t = -t
            c = one / wp.sqrt(one + t * t)
            s = c * t
    return c * a - s * b, s * a + c * b, c * v - s * w, s * v + c * w


@wp.func
def _ordered(a: Any, b: Any, v: Any, w: Any):
    """(a, b, v, w) with |a| >= |b|: swapped by a quarter turn, which keeps the orientation of (v, w)."""
    if wp.dot(a, a) < wp.dot(b, b):
        return b, -a, w, -v
    return a, b, v, w


@wp.func
def _any_perpendicular(a: Any):
    """A unit vector perpendicular to the unit 3-vector a."""
    zero = a.dtype(0.0)
    if wp.abs(a[0]) > wp.abs(a[2]):
        return wp.normalize(wp.vector(-a[1], a[0], zero))
    return wp.normalize(wp.vector(zero, -a[2], a[1]))


@wp.func
def signed_svd(F: mat22):
    """Rotations U, V and signed singular values s with F = U diag(s) V^T, s0 >= |s1| (Irving et al. 2004).

    By one-sided Jacobi rotations, accurate for any scale. Not differentiable by Warp.
    """
    one = F.dtype(1.0)
    zero = F.dtype(0.0)
    scale = wp.max(wp.max(wp.abs(F[0, 0]), wp.abs(F[0, 1])), wp.max(wp.abs(F[1, 0]), wp.abs(F[1, 1])))
    inverse_scale = one
    if scale > zero:
        inverse_scale = one / scale
    a = wp.vector(F[0, 0], F[1, 0]) * inverse_scale
    b = wp.vector(F[0, 1], F[1, 1]) * inverse_scale
    v = wp.vector(one, zero)
    w = wp.vector(zero, one)
    a, b, v, w = _orthogonalize(a, b, v, w)
    a, b, v, w = _ordered(a, b, v, w)
    s0 = wp.length(a)
    u = wp.vector(one, zero)
    if s0 > zero:
        u = a / s0
    u1 = wp.vector(-u[1], u[0])
    return wp.matrix_from_cols(u, u1), wp.vector(s0, wp.dot(u1, b)) * scale, wp.matrix_from_cols(v, w)


@wp.func
def signed_svd(F: mat33):  # noqa: F811
    """Rotations U, V and signed singular values s with F = U diag(s) V^T, s0 >= s1 >= |s2|."""
    one = F.dtype(1.0)
    zero = F.dtype(0.0)
    scale = zero
    for i in range(3):
        for j in range(3):
            scale = wp.max(scale, wp.abs(F[i, j]))
    inverse_scale = one
    if scale > zero:
        inverse_scale = one / scale
    a = wp.vector(F[0, 0], F[1, 0], F[2, 0]) * inverse_scale
    b = wp.vector(F[0, 1], F[1, 1], F[2, 1]) * inverse_scale
    c = wp.vector(F[0, 2], F[1, 2], F[2, 2]) * inverse_scale
    u = wp.vector(one, zero, zero)
    v = wp.vector(zero, one, zero)
    w = wp.vector(zero, zero, one)
    sweeps = int(6)
    for _sweep in range(sweeps):
        if _orthogonal(a, b) and _orthogonal(b, c) and _orthogonal(a, c):
            break
        a, b, u, v = _orthogonalize(a, b, u, v)
        b, c, v, w = _orthogonalize(b, c, v, w)
        a, c, u, w = _orthogonalize(a, c, u, w)
    a, b, u, v = _ordered(a, b, u, v)
    b, c, v, w = _ordered(b, c, v, w)
    a, b, u, v = _ordered(a, b, u, v)
    s0 = wp.length(a)
    u0 = wp.vector(one, zero, zero)
    if s0 > zero:
        u0 = a / s0
    b_rest = b - wp.dot(u0, b) * u0
    u1 = _any_perpendicular(u0)
    if wp.length(b_rest) > F.dtype(1.0e-30):
        u1 = wp.normalize(b_rest)
        u1 = wp.normalize(u1 - wp.dot(u0, u1) * u0)
    u2 = wp.cross(u0, u1)
    s = wp.vector(s0, wp.dot(u1, b), wp.dot(u2, c)) * scale
    return wp.matrix_from_cols(u0, u1, u2), s, wp.matrix_from_cols(u, v, w)


# --- rotation of the polar decomposition -----------------------------------------------------------------


@wp.func
def direct_rotation(F: mat22):
    """:func:`polar_rotation` without branches, and 1: it holds for every F."""
    return polar_rotation(F), 1


@wp.func
def direct_rotation(F: mat33):  # noqa: F811
    """:func:`polar_rotation` without branches, and whether it holds (1) or not (0).

    With |F| = 1, i1 = tr S is the largest root of l^4 - 2 l^2 - 8 J l + 1 - 4 |cof F|^2, the characteristic polynomial
    of Davenport's matrix. All its roots are real, and from sqrt(3) on Laguerre's method falls to the largest at third
    order. By Cayley-Hamilton, with i2 and J the other invariants of S,
    R = ((i1^2 - i2) F + i1 cof F - F F^T F) / (i1 i2 - J). It holds unless that denominator, the product of the sums of
    two singular values, nearly vanishes: in a dense sample of those that hold, four steps leave 1e-12 in i1.
    """
    one = F.dtype(1.0)
    half = F.dtype(0.5)
    least = F.dtype(5.0e-2)
    A = F * (one / wp.sqrt(wp.ddot(F, F)))
    C = cofactor(A)
    J = wp.determinant(A)
    c0 = one - F.dtype(4.0) * wp.ddot(C, C)
    i1 = F.dtype(1.7320508075688772)
    for _step in range(4):
        square = i1 * i1
        value = (square - F.dtype(2.0)) * square - F.dtype(8.0) * J * i1 + c0
        slope = i1 * (square - one) - F.dtype(2.0) * J  # a quarter of it
        bend = F.dtype(9.0) * slope * slope - F.dtype(3.0) * value * (F.dtype(3.0) * square - one)
        i1 = i1 - value / wp.max(slope + wp.sqrt(wp.max(bend, F.dtype(0.0))), F.dtype(1.0e-6))
    i2 = half * (i1 * i1 - one)
    denominator = i1 * i2 - J
    inverse = one / wp.max(denominator, least)
    R = ((i1 * i1 - i2) * A + i1 * C - A * (wp.transpose(A) * A)) * inverse
    R = R * (F.dtype(1.5) * identity_like(F) - half * (wp.transpose(R) * R))  # the rotation nearest to R
    M = wp.transpose(R) * A
    pair_sums = wp.trace(M) * identity_like(M) - symmetric_part(M)
    axial = wp.vector(M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1])
    R = R + R * skew(cofactor(pair_sums) * axial * inverse)  # Newton on skew(R^T A) = 0
    return R, wp.where(denominator > least, 1, 0)


@wp.func
def polar_rotation(F: mat22):
    """The proper rotation R of F = R S with S symmetric and tr S >= 0: the rotation closest to F."""
    one = F.dtype(1.0)
    zero = F.dtype(0.0)
    c = F[0, 0] + F[1, 1]
    s = F[1, 0] - F[0, 1]
    r = wp.length(wp.vector(c, s))
    c = wp.where(r > zero, c / r, one)
    s = wp.where(r > zero, s / r, zero)
    return wp.matrix_from_rows(wp.vector(c, -s), wp.vector(s, c))


@wp.func
def polar_rotation(F: mat33):  # noqa: F811
    """The proper rotation R of F = R S closest to F, also for inverted F (there S has a negative eigenvalue).

    The direct one; where that does not hold, the signed singular value decomposition decides.
    """
    R, holds = direct_rotation(F)
    if holds == 1:
        return R
    if not (wp.ddot(F, F) > F.dtype(0.0)):
        return identity_like(F)
    U, _s, V = signed_svd(F)
    return U * wp.transpose(V)


@wp.func
def skew(w: Any):
    """The matrix of the cross product with the 3-vector w."""
    zero = w.dtype(0.0)
    return wp.matrix_from_rows(wp.vector(zero, -w[2], w[1]), wp.vector(w[2], zero, -w[0]), wp.vector(-w[1], w[0], zero))


@wp.func
def _least_stretch_sum(like: wp.float32):
    """The relative size below which rounding hides the sum of two singular values."""
    return wp.float32(1.0e-6)


@wp.func
def _least_stretch_sum(like: wp.float64):
    return wp.float64(1.0e-14)


@wp.func
def _rotation_rate(R: mat33, F: mat33, G: mat33):
    """The vector w with R^T dR = skew(w) when F changes by G: (tr(S) I - S) w = axial(R^T G - G^T R).

    The matrix has the eigenvalues s_i + s_j; where one is nearly 0 the rate is bounded instead of infinite.
    """
    S = symmetric_part(wp.transpose(R) * F)
    A = wp.trace(S) * identity_like(S) - S
    T = wp.transpose(R) * G
    axial = wp.vector(T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1])
    size = wp.trace(A)
    floor = _least_stretch_sum(size) * wp.abs(size) * size * size + F.dtype(1.0e-30)
    determinant = wp.determinant(A)
    return cofactor(A) * axial / wp.where(wp.abs(determinant) < floor, floor, determinant)


@wp.func
def rotation_change(R: mat22, F: mat22, G: mat22):
    """dR for the change G of F, whose rotation is R."""
    T = wp.transpose(R) * G
    stretch = wp.length(wp.vector(F[0, 0] + F[1, 1], F[1, 0] - F[0, 1]))
    floor = _least_stretch_sum(stretch) * wp.sqrt(wp.ddot(F, F)) + F.dtype(1.0e-30)
    w = (T[1, 0] - T[0, 1]) / wp.max(stretch, floor)
    zero = F.dtype(0.0)
    return R * wp.matrix_from_rows(wp.vector(zero, -w), wp.vector(w, zero))


@wp.func
def rotation_change(R: mat33, F: mat33, G: mat33):  # noqa: F811
    """dR for the change G of F, whose rotation is R, guarded where two singular values sum to zero."""
    return R * skew(_rotation_rate(R, F, G))


@wp.func
def rotation_differential(F: Any, G: Any):
    """dR for the change G of F."""
    return rotation_change(polar_rotation(F), F, G)


@functools.cache
def differentiable_rotation() -> wp.Function:
    """:func:`polar_rotation` with the exact derivative for Warp's reverse mode.

    Made when first asked for: to attach a derivative, Warp analyses all that the function calls, which takes as long
    as to import the rest of this package.
    """
    for matrix in (wp.mat22f, wp.mat22d, wp.mat33f, wp.mat33d):

        @wp.func
        def rotation(F: matrix):
            return polar_rotation(F)

        @wp.func_grad(rotation)
        def adjoint_rotation(F: matrix, adjoint: matrix):
            wp.adjoint[F] += rotation_differential(F, adjoint)  # dR/dF is symmetric

    return rotation
