"""How large an explicit time step may be, and whether a run has outgrown it."""

import numpy as np
import warp as wp

from warpfem.dtypes import part_of, uniform_array
from warpfem.errors import SimulationError
from warpfem.launches import Recordings, jobs
from warpfem.linear import tangent_operator
from warpfem.model import CellBlock, Model, State
from warpfem.solvers.base import require_finite, worst_cell
from warpfem.solvers.vectorized_frequency import VectorizedFrequency, can_vectorize
from warpfem.threads import Job, share

POWER_ITERATIONS = 60
"""Products with the stiffness that decide whether a step is unstable for certain."""

LARGEST_GAIN, LARGEST_ADAPTIVE_GAIN = 100.0, 3.0
"""The most that the energy may grow, over what the start and the loads make available: a run on the brink of
stability may show 50 times of it, because it conserves another energy than the one that is measured; one at the part
of the limit that ``dt="auto"`` takes, 4 times."""


def largest_frequency(model: Model, u: wp.array | None = None) -> float:
    """An upper bound of the largest angular frequency [rad/s] of the model about ``u`` (default: at rest).

    The largest eigenvalue of the cells' own (K_e, M_e) bounds that of the assembled pair (Irons and Treharne
    1971). It is bounded in turn by (tr A^p)^(1/p), A = M_e^-1/2 K_e M_e^-1/2, which exceeds it by at most
    (rank A)^(1/p): at rest 1.25 for linear tetrahedra and 1.15 for triangles (p = 8), 1.10 and 1.07 for quadratic ones
    (p = 32), and so dt by at most 12 %. Contact adds the largest ratio of its normal stiffness to a point's mass.
    """
    if u is None:
        u = model.zeros()
    largest = 0.0
    density = _cell_densities(model)
    for block in model.blocks:
        bounds = _linear_bounds(model, block, u) if block.shape.order == 1 else _quadratic_bounds(model, block, u)
        largest = np.maximum(largest, (bounds / density[block.index]).max())  # not a number stays
    if model.contact is not None:
        largest += model.contact.largest_stiffness_over_mass(model.host_mass)
    return float(np.sqrt(largest))


def _linear_bounds(model: Model, block: CellBlock, u: wp.array) -> np.ndarray:
    """(tr A^8)^(1/8) of each cell at unit density, (count,) float64."""
    out = wp.zeros(block.count, dtype=wp.float64, device=block.device)
    parts = [slice(cells.start, cells.stop) for cells in share(block.count, model.team.size)]
    kernels = block.bounding_kernels
    launches = [[block.launch("frequency_bound", [u], [out[p]], part=p, kernels=kernels, record=True)] for p in parts]
    model.team.run(jobs(launches))
    return block.shape.point_count * out.numpy()


def _quadratic_bounds(model: Model, block: CellBlock, u: wp.array) -> np.ndarray:
    """(tr A^32)^(1/32) of each cell at unit density, (count,) float64."""
    parts = []
    volume = np.concatenate([body.mesh.cell_volumes for body in model.scene.bodies])[block.index]
    roots = np.sqrt(np.repeat(block.shape.mass_shares, model.dim))
    for part, stiffness in model.element_stiffness_parts(block, u):
        A = stiffness.reshape(len(stiffness), len(roots), -1) / volume[part, None, None]
        A /= np.outer(roots, roots)
        scale = np.linalg.norm(A, axis=(1, 2))
        A = A / np.where(scale > 0.0, scale, 1.0)[:, None, None]
        for _ in range(4):
            A = A @ A
        parts.append(scale * np.linalg.norm(A, axis=(1, 2)) ** (1 / 16))
    return np.concatenate(parts)


def _cell_densities(model: Model) -> np.ndarray:
    """The density of every cell, (cell_count,) [kg/m^3]."""
    bodies = model.scene.bodies
    return np.concatenate([np.broadcast_to(body.density, body.mesh.cell_count) for body in bodies])


class Watch:
    """Follows the stability limit and the energy of an explicit run.

    The estimate of the frequency is that of each cell alone, as in :func:`largest_frequency`, by power iteration
    in a kernel: a few per cent of the cost of the bound. It is within a few per cent of it unless strains are large
    and different in all directions, where it can be too low by a third.

    Args:
        model: the model.
        state: the state that the energy is measured against.
    """

    def __init__(self, model: Model, state: State) -> None:
        self.model = model
        density = _cell_densities(model)
        self._densities = [self._device_array(density[block.index]) for block in model.blocks]
        self._vectorized = [
            VectorizedFrequency(block, float(density[block.index[0]]))
            if can_vectorize(block, density[block.index])
            else None
            for block in model.blocks
        ]
        # one for each thread: shared, they would lose each other's maxima
        self._squares = wp.zeros(model.team.size, dtype=model.types.scalar, device=model.device)
        self._recordings = Recordings()
        self._contact = 0.0 if model.contact is None else model.contact.largest_stiffness_over_mass(model.host_mass)
        self._start = model.energies(state)
        size = max(float(np.linalg.norm(np.ptp(body.mesh.bounding_box, axis=0))) for body in model.scene.bodies)
        self._floor = 0.5 * float(model.host_mass.sum()) * size**2
        self._size = size
        self._proved = np.inf

    def _device_array(self, density: np.ndarray) -> wp.array:
        if np.ptp(density) == 0.0:
            return uniform_array(density[:1], len(density), self.model.types.scalar, self.model.device)
        return wp.array(density, dtype=self.model.types.scalar, device=self.model.device)

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        vectorized = [array for own in self._vectorized if own is not None for array in own.arrays()]
        return [*self._densities, self._squares, *vectorized]

    def stable_dt(self, u: wp.array) -> float:
        """The estimate of the largest stable time step [s] at the displacements ``u``."""
        for block in self.model.blocks:
            if block.averaged:
                block.update_pressure(u)
        square = self._largest_square(u, together=True)
        if square is None:
            square = self._largest_square(u, together=False)
            assert square is not None
        square += self._contact
        return 2.0 / float(np.sqrt(square)) if square > 0.0 else np.inf

    def _largest_square(self, u: wp.array, together: bool) -> float | None:
        """The largest squared frequency of a cell [1/s^2].

        Args:
            u: displacements.
            together: whether several cells are taken at a time where that is possible: ``None`` is returned where that
                does not tell those of all.
        """
        self._squares.zero_()
        self.model.team.run(self._recordings.get((u.ptr, together), lambda: self._record(u, together)))
        squares = [own.square() for own in self._vectorized if own is not None] if together else []
        if any(square is None for square in squares):
            return None
        return float(np.max([self._squares.numpy().max(), *squares]))

    def _record(self, u: wp.array, together: bool) -> list[Job]:
        """The launches of the cells' frequencies, divided among threads."""
        launches: list[list[wp.Launch | None]] = [[] for _ in range(len(self._squares))]
        for block, density, vectorized in zip(self.model.blocks, self._densities, self._vectorized, strict=True):
            if together and vectorized is not None:
                for thread, own in enumerate(launches):
                    own.append(vectorized.record(u, thread))
                continue
            for thread, cells in enumerate(share(block.count, len(launches))):
                part = slice(cells.start, cells.stop)
                launches[thread].append(
                    block.launch(
                        "frequency",
                        [part_of(density, part), u],
                        [self._squares[thread : thread + 1]],
                        part=part,
                        kernels=block.bounding_kernels,
                        record=True,
                    )
                )
        return jobs(launches)

    def certain_limit(self, state: State) -> float:
        """A time step [s] above which steps are unstable for certain: by power iteration on M^-1 K of the whole."""
        model = self.model
        operator = tangent_operator(model, "closed")
        operator.linearize(state.u, mass_weight=0.0)
        x, product = model.zeros(), model.zeros()
        start = np.random.default_rng(0).normal(size=(model.point_count, model.dim))
        x.assign(start.astype(model.types.numpy))
        if model.supports is not None:
            model.supports.project(x)
        inverse_mass = model.inverse_mass.numpy().astype(np.float64)[:, None]
        square = 0.0
        for _ in range(POWER_ITERATIONS):
            operator.apply(x, product)
            y, force = x.numpy().astype(np.float64), product.numpy().astype(np.float64)
            if not y.any() or not np.isfinite(force).all():
                break
            square = max(square, float((y * force).sum() / (y * y / inverse_mass).sum()))  # Rayleigh: from below
            y = inverse_mass * force
            x.assign((y / max(np.abs(y).max(), np.finfo(np.float64).tiny)).astype(model.types.numpy))
        return 2.0 / float(np.sqrt(square)) if square > 0.0 else np.inf

    def is_unstable(self, state: State, dt: float) -> float | None:
        """The stability limit [s] if ``dt`` is above it for certain, else ``None``."""
        estimate = self.stable_dt(state.u)
        if dt <= estimate or estimate > 0.97 * self._proved:
            return None
        limit = self.certain_limit(state)
        if dt > limit:
            return limit
        self._proved = estimate
        return None

    def _drift(self, velocity: np.ndarray) -> np.ndarray:
        """The mean velocity of each body, for each of its points."""
        means = [velocity[points].mean(axis=0) for points, _ in self.model.body_slices]
        return np.repeat(means, np.diff(self.model.point_starts), axis=0)

    def require_bounded(self, state: State, dt: float, adaptive: bool = False) -> None:
        """Checks the state by its numbers, its energy and its speed.

        Raises:
            SimulationError: it has grown out of bounds.
        """
        model = self.model
        require_finite(model, state.u, "the displacement", state.time)
        require_finite(model, state.v, "the velocity", state.time)
        now, start = model.energies(state), self._start
        speed = np.linalg.norm(state.velocity - self._drift(state.velocity), axis=1)
        fastest = int(np.argmax(speed))
        body, point = model.body_of_point(fastest)
        where = f"the fastest point is {point} of body '{body.name}', at {speed[fastest]:.3g} m/s from the mean"
        advice = "take BackwardEuler" if adaptive else 'take a smaller dt, dt="auto", or BackwardEuler'
        largest_gain = LARGEST_ADAPTIVE_GAIN if adaptive else LARGEST_GAIN
        available = start.kinetic + start.elastic + start.contact + max(0.0, start.load - now.load)
        gain = now.total - start.total
        moving = model.supports is not None and model.supports.moving
        if not np.isfinite(now.total) or (not moving and gain > largest_gain * available + 1e-12 * self._floor / dt**2):
            raise SimulationError(
                f"t = {state.time:.6g} s: the run has blown up: its energy has grown by {gain:.3g} J, of which "
                f"{available:.3g} J were there to be had; {where}; {worst_cell(model, state.u)}. Explicit steps of "
                f"{dt:.3g} s are too long here: {advice}"
            )
        if moving and speed[fastest] * dt > self._size:
            raise SimulationError(
                f"t = {state.time:.6g} s: {where}: further than the size of the body, {self._size:.3g} m, in a step "
                f"of {dt:.3g} s: {advice}"
            )
