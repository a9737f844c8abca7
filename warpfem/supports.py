"""Pins and prescribed motions on the device: which components are held, and where."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import warp as wp

from warpfem.boundary import Pin, PrescribedMotion, Support
from warpfem.dtypes import types
from warpfem.errors import SceneError, source_of, user_code
from warpfem.launches import Launcher
from warpfem.scene import Body


@functools.cache
def support_kernels(dim: int, dtype: str) -> SimpleNamespace:
    """The kernels ``hold`` and ``project``."""
    t = types(dim, dtype)
    vector, scalar = t.vector, t.scalar
    module = f"warpfem.supports_{dim}_{dtype}"

    @wp.kernel(module=module, enable_backward=False)
    def hold(
        points: wp.array(dtype=wp.int32),
        held: wp.array(dtype=vector),
        target: wp.array(dtype=vector),
        target_rate: wp.array(dtype=vector),
        u_out: wp.array(dtype=vector),
        v_out: wp.array(dtype=vector),
    ):
        """Puts the held components (held = 1) at their target."""
        k = wp.tid()
        i = points[k]
        one = vector(scalar(1.0))
        u_out[i] = wp.cw_mul(one - held[k], u_out[i]) + wp.cw_mul(held[k], target[k])
        v_out[i] = wp.cw_mul(one - held[k], v_out[i]) + wp.cw_mul(held[k], target_rate[k])

    @wp.kernel(module=module, enable_backward=False)
    def project(points: wp.array(dtype=wp.int32), held: wp.array(dtype=vector), vector_out: wp.array(dtype=vector)):
        """Sets the held components of a vector to zero."""
        k = wp.tid()
        i = points[k]
        vector_out[i] = wp.cw_mul(vector(scalar(1.0)) - held[k], vector_out[i])

    return SimpleNamespace(hold=hold, project=project)


_SAMPLES = (0.25, 0.382, 0.5, 0.75)
"""Where the way of supports is looked at: not only where a number of full turns has come round."""


@dataclass
class _Moving:
    body: str
    points: np.ndarray  # numbers in the body's mesh
    rows: np.ndarray  # their places among the held points
    held: np.ndarray  # (k, dim) bool
    rest: np.ndarray  # (k, dim)
    motion: Callable[[np.ndarray, float], np.ndarray]

    def displacement(self, time: float) -> np.ndarray:
        with user_code(f"body '{self.body}', prescribed motion at t = {time:g} s", source_of(self.motion)):
            x = np.asarray(self.motion(self.rest.copy(), time))
        if x.dtype.kind not in "fiu":
            raise SceneError(
                f"body '{self.body}': the prescribed motion returned {x.dtype} at t = {time:g} s; expected numbers"
            )
        if x.shape != self.rest.shape:
            raise SceneError(
                f"body '{self.body}': the prescribed motion returned shape {x.shape} at t = {time:g} s; "
                f"expected {self.rest.shape}"
            )
        bad = ~np.isfinite(x).all(axis=1)
        if bad.any():
            raise SceneError(
                f"body '{self.body}': the prescribed motion is not finite at t = {time:g} s "
                f"for point {int(self.points[np.argmax(bad)])} ({int(bad.sum())} in all)"
            )
        return x - self.rest


class Supports:
    """All held components of a scene.

    Attributes:
        count: held points.
        points: (count,) int32 device array.
        held: (count,) vectors of 1 (held) and 0 (free).
    """

    def __init__(self, bodies: Sequence[Body], starts: Sequence[int], dim: int, dtype: str, device) -> None:
        self.types = types(dim, dtype)
        self.kernels = support_kernels(dim, dtype)
        self.device = device
        self._launch = Launcher(device)
        claims: dict[tuple[int, int], Support] = {}
        motions = []
        for body, start in zip(bodies, starts, strict=True):
            for support in body.supports:
                if not isinstance(support, Pin | PrescribedMotion):
                    raise SceneError(f"body '{body.name}': {support!r} is not a Pin or PrescribedMotion")
                try:
                    selected = body.mesh.select_points(support.points)
                except ValueError as error:
                    raise SceneError(f"body '{body.name}', {type(support).__name__}: {error}") from None
                axes = self._axes(body, support)
                for point in selected:
                    for axis in axes:
                        other = claims.setdefault((start + int(point), axis), support)
                        if other is not support and not (isinstance(other, Pin) and isinstance(support, Pin)):
                            raise SceneError(
                                f"body '{body.name}': component {axis} of point {point} is claimed by a "
                                f"{type(other).__name__} and by a {type(support).__name__}: choose one"
                            )
                if isinstance(support, PrescribedMotion):
                    motions.append((body, start, selected, axes, support.motion))
        self.host_points = np.unique(np.array([point for point, _ in claims], dtype=np.int32))
        self.count = len(self.host_points)
        held = np.zeros((self.count, dim))
        index, component = np.array(list(claims), dtype=np.int64).reshape(-1, 2).T
        held[np.searchsorted(self.host_points, index), component] = 1.0
        self.points = wp.array(self.host_points, dtype=wp.int32, device=device)
        self.held = wp.array(held, dtype=self.types.vector, device=device)
        self._target = np.zeros((self.count, dim))
        self._moving: list[_Moving] = []
        for body, start, selected, axes, motion in motions:
            mask = np.zeros((len(selected), dim), dtype=bool)
            mask[:, list(axes)] = True
            rows = np.searchsorted(self.host_points, start + selected)
            self._moving.append(_Moving(body.name, selected, rows, mask, body.mesh.points[selected], motion))
        self.target = wp.zeros(self.count, dtype=self.types.vector, device=device)
        self.target_rate = wp.zeros(self.count, dtype=self.types.vector, device=device)

    @staticmethod
    def _axes(body: Body, support: Pin | PrescribedMotion) -> tuple[int, ...]:
        dim = body.mesh.dim
        axes = range(dim) if support.axes is None else np.array(support.axes, dtype=object, ndmin=1).tolist()
        if not axes or any(isinstance(axis, bool | np.bool_ | float) or axis not in range(dim) for axis in axes):
            raise SceneError(
                f"body '{body.name}', {type(support).__name__}: axes {support.axes!r} must be among 0..{dim - 1}"
            )
        return tuple(axes)

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        return [self.points, self.held, self.target, self.target_rate]

    @property
    def moving(self) -> bool:
        """Whether any held point moves."""
        return bool(self._moving)

    def advance(self, time: float, dt: float) -> None:
        """Sets the targets to those at ``time`` and their rates to the mean over the last ``dt``."""
        if not self._moving:
            return
        target = self._target
        rate = np.zeros_like(target)
        for part in self._moving:
            now = part.displacement(time)
            mean_rate = (now - part.displacement(time - dt)) / dt if dt > 0.0 else np.zeros_like(now)
            target[part.rows] = np.where(part.held, now, target[part.rows])
            rate[part.rows] = np.where(part.held, mean_rate, rate[part.rows])
        self.target.assign(target.astype(self.types.numpy))
        self.target_rate.assign(rate.astype(self.types.numpy))

    def approach(self, time: float, fraction: float) -> None:
        """Sets the targets to those at a fraction of the way from rest to ``time``.

        They are those at ``fraction`` times ``time``, less what is left of the displacement that a motion begins with.
        """
        if self._moving:
            self.target.assign(self._on_the_way(time, fraction).astype(self.types.numpy))
            self.target_rate.zero_()

    def bend(self, time: float, first: float, last: float) -> float:
        """How far the way of :meth:`approach` strays from the straight between two fractions, relative to its length.

        In a turn by 90 degrees it is 0.2, in a full one infinite.
        """
        if not self._moving:
            return 0.0
        start, end = self._on_the_way(time, first), self._on_the_way(time, last)
        strayed = 0.0
        for s in _SAMPLES:
            straight = (1.0 - s) * start + s * end
            place = self._on_the_way(time, (1.0 - s) * first + s * last)
            strayed = max(strayed, float(np.linalg.norm(place - straight, axis=1).max()))
        length = float(np.linalg.norm(end - start, axis=1).max())
        rounding = 1e-12 * max(float(np.abs(part.rest).max()) for part in self._moving)
        if strayed <= rounding:
            return 0.0
        return strayed / length if length > 0.0 else np.inf

    def _on_the_way(self, time: float, fraction: float) -> np.ndarray:
        target = np.zeros_like(self._target)
        for part in self._moving:
            now = part.displacement(fraction * time) - (1.0 - fraction) * part.displacement(0.0)
            target[part.rows] = np.where(part.held, now, target[part.rows])
        return target

    def hold(self, u: wp.array, v: wp.array) -> None:
        """Puts the held components of ``u`` and ``v`` at their targets."""
        inputs = [self.points, self.held, self.target, self.target_rate]
        self._launch(self.kernels.hold, self.count, inputs, [u, v])

    def record_hold(self, u: wp.array, v: wp.array) -> wp.Launch:
        """The launch of :meth:`hold`."""
        return wp.launch(
            self.kernels.hold,
            self.count,
            inputs=[self.points, self.held, self.target, self.target_rate],
            outputs=[u, v],
            device=self.device,
            record_cmd=True,
        )

    def project(self, vector: wp.array) -> None:
        """Sets the held components of ``vector`` to zero."""
        self._launch(self.kernels.project, self.count, [self.points, self.held], [vector])
