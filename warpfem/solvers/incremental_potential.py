"""The incremental potential: what one solve of an implicit step minimises, by its terms."""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from warpfem.dtypes import types
from warpfem.launches import Launcher, Total
from warpfem.linear import Hessian, TangentOperator, tangent_operator
from warpfem.model import Model, Route
from warpfem.points import CHUNK, chunks


@functools.cache
def _kernels(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    vector, matrix, scalar = t.vector, t.matrix, t.scalar
    module = f"warpfem.implicit_{dim}_{dtype}"

    @wp.kernel(module=module, enable_backward=False)
    def add_scaled(
        a: wp.array(dtype=vector),
        factor: scalar,
        b: wp.array(dtype=vector),
        sum_out: wp.array(dtype=vector),
    ):
        """Writes a + factor b."""
        i = wp.tid()
        sum_out[i] = a[i] + factor * b[i]

    @wp.kernel(module=module, enable_backward=False)
    def free_flight(
        predicted: wp.array(dtype=vector),
        load: wp.array(dtype=vector),
        inverse_mass: wp.array(dtype=scalar),
        inverse_weight: scalar,
        increment_out: wp.array(dtype=vector),
    ):
        """Writes how far dead loads alone would take the points."""
        i = wp.tid()
        increment_out[i] = predicted[i] + (inverse_weight * inverse_mass[i]) * load[i]

    @wp.kernel(module=module, enable_backward=False)
    def inertia_energy(
        mass: wp.array(dtype=scalar),
        weight: scalar,
        predicted: wp.array(dtype=vector),
        increment: wp.array(dtype=vector),
        energy_out: wp.array(dtype=wp.float64),
    ):
        """Adds weight/2 |increment - predicted|^2_M."""
        first = wp.tid() * CHUNK
        last = wp.min(first + CHUNK, increment.shape[0])
        total = wp.float64(0.0)
        for i in range(first, last):
            d = increment[i] - predicted[i]
            square = wp.float64(0.0)
            for k in range(dim):
                square += wp.float64(d[k]) * wp.float64(d[k])
            total += wp.float64(mass[i]) * square
        wp.atomic_add(energy_out, 0, wp.float64(0.5) * wp.float64(weight) * total)

    @wp.kernel(module=module, enable_backward=False)
    def inertia_force(
        mass: wp.array(dtype=scalar),
        weight: scalar,
        predicted: wp.array(dtype=vector),
        increment: wp.array(dtype=vector),
        force_out: wp.array(dtype=vector),
    ):
        """Writes -weight M (increment - predicted)."""
        i = wp.tid()
        force_out[i] = (weight * mass[i]) * (predicted[i] - increment[i])

    @wp.kernel(module=module, enable_backward=False)
    def rounding(
        inverse_diagonal: wp.array(dtype=matrix),
        mass: wp.array(dtype=scalar),
        weight: scalar,
        epsilon: scalar,
        u: wp.array(dtype=vector),
        increment: wp.array(dtype=vector),
        force_out: wp.array(dtype=vector),
        work_out: wp.array(dtype=wp.float64),
    ):
        """Writes the change of force that one rounding of u and of the increment makes, and sums its work.

        It is epsilon (|K_ii| |u_i| + weight m_i |d_i|) with the blocks K_ii + weight m_i I on the diagonal.
        """
        i = wp.tid()
        inertia = weight * mass[i]
        scale = wp.trace(inverse_diagonal[i])
        block = wp.inverse(inverse_diagonal[i] / scale) / scale
        force = vector()
        work = scalar(0.0)
        for k in range(dim):
            elastic = scalar(0.0)
            for j in range(dim):
                entry = block[k, j]
                if j == k:
                    entry -= inertia
                elastic += wp.abs(entry * u[i][j])
            moved = wp.abs(increment[i][k])
            force[k] = epsilon * (elastic + inertia * moved)
            work += epsilon * (elastic * wp.abs(u[i][k]) + inertia * moved * moved)
        force_out[i] = force
        wp.atomic_add(work_out, 0, wp.float64(work))

    return SimpleNamespace(
        add_scaled=add_scaled,
        free_flight=free_flight,
        inertia_energy=inertia_energy,
        inertia_force=inertia_force,
        rounding=rounding,
    )


class IncrementalPotential:
    """The potential of the increment d of the displacements,

    Phi(d) = w/2 |d - d~|^2_M + U(u) - f_dead . u + contact(u) + friction(u),  u = u_b + d,

    with supports at the targets that the model's were last advanced to. Inertia comes from d itself: the difference
    of two displacements would lose it in short steps. With w = 0 it is the potential energy.

    Attributes:
        model: the model.
        base: u_b, displacements, device array [m].
        weight: w, the weight of inertia [1/s^2].
        predicted: d~, how far inertia alone would take the points, device array [m], for the caller to fill.
        duration: time within which friction slips from u_b to u [s].
        operator: its second derivative.
        force: -dPhi/dd, device array [N], zero where held, after :meth:`unbalanced_force`.
    """

    def __init__(self, model: Model, differential: Route) -> None:
        self.model = model
        self.kernels = _kernels(model.dim, model.dtype)
        self.operator: TangentOperator = tangent_operator(model, differential)
        self.predicted, self.force, self.part = (model.zeros() for _ in range(3))
        self._sum = Total(model.device)
        self._launcher = Launcher(model.device)
        self._barriers = [block for block in model.blocks if block.kernels.constitutive.barrier]
        limited = self._barriers or (model.contact is not None and model.contact.limits_steps)
        self._limit = wp.zeros(1, dtype=model.types.scalar, device=model.device) if limited else None

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        own = [self.predicted, self.force, self.part, self._sum.array]
        if self._limit is not None:
            own.append(self._limit)
        return [*own, *self.operator.arrays()]

    def pose(self, base: wp.array, weight: float, duration: float) -> None:
        """Takes u_b [m], which is not copied, w [1/s^2] and the time of slip [s]."""
        self.base, self.weight, self.duration = base, weight, duration

    @property
    def has_barriers(self) -> bool:
        """Whether a material does not bear inversion."""
        return bool(self._barriers)

    @property
    def limits_steps(self) -> bool:
        """Whether :meth:`longest_step` can be less than 1."""
        return self._limit is not None

    def add_scaled(self, a: wp.array, factor: float, b: wp.array, sum_out: wp.array) -> None:
        """Writes a + factor b, for vectors per point."""
        self._launch("add_scaled", [a, factor, b], [sum_out])

    def move(self, d: wp.array, u_out: wp.array) -> None:
        """Writes u = u_b + d, with held components at their targets."""
        self.add_scaled(self.base, 1.0, d, u_out)
        if self.model.supports is not None:
            self.model.supports.hold(u_out, self.part)  # the rates go to a work array

    def fly(self, increment_out: wp.array, acceleration: wp.array | None = None) -> None:
        """Writes how far inertia and an acceleration, or else dead loads, would take the points, zero where held."""
        model = self.model
        if acceleration is not None:
            self.add_scaled(self.predicted, 1.0 / self.weight, acceleration, increment_out)
        elif model.dead_load is None:
            wp.copy(increment_out, self.predicted)
        else:
            arguments = [self.predicted, model.dead_load, model.inverse_mass, 1.0 / self.weight]
            self._launch("free_flight", arguments, [increment_out])
        if model.supports is not None:
            model.supports.project(increment_out)

    def value(self, d: wp.array, u: wp.array) -> float:
        """Phi of the increment d, which leads to u [J]."""
        model, total = self.model, self._sum.array
        self._sum.clear()
        inputs = [model.mass, self.weight, self.predicted, d]
        self._launcher(self.kernels.inertia_energy, chunks(model.point_count), inputs, [total])
        for block in model.blocks:
            block.launch("energy", [u], [total])
        if model.contact is not None:
            model.contact.add_energy(u, total)
            model.contact.add_friction_energy(self.base, self.duration, u, total)
        load = 0.0 if model.dead_load is None else model.dot(model.dead_load, u)
        return self._sum.read() - load

    def unbalanced_force(self, d: wp.array, u: wp.array) -> tuple[np.ndarray, np.ndarray]:
        """Writes -dPhi/dd to :attr:`force`.

        Returns:
            For each body, since none feels another, its norm and that of the largest of its parts, where not held;
            without inertia, the internal force at held components counts among the parts.
        """
        model, force, part = self.model, self.force, self.part
        self._launch("inertia_force", [model.mass, self.weight, self.predicted, d], [force])
        sizes = [self._free_norms(force)]
        part.zero_()
        model.add_internal_force(u, part)
        if self.weight == 0.0:  # where supports alone strain a body at rest, no other force acts
            sizes.append(self._norms(part))
        sizes.append(self._free_norms(part))
        self.add_scaled(force, 1.0, part, force)
        if model.dead_load is not None:
            wp.copy(part, model.dead_load)
            sizes.append(self._free_norms(part))
            self.add_scaled(force, 1.0, part, force)
        if model.contact is not None:
            part.zero_()
            model.contact.add_force(u, part)
            model.contact.add_friction_force(self.base, self.duration, u, part)
            sizes.append(self._free_norms(part))
            self.add_scaled(force, 1.0, part, force)
        return self._free_norms(force), np.max(sizes, axis=0)

    def internal_norms(self, u: wp.array) -> np.ndarray:
        """Each body's norm of the internal force, where held too [N]."""
        self.part.zero_()
        self.model.add_internal_force(u, self.part)
        return self._norms(self.part)

    def _free_norms(self, vector: wp.array) -> np.ndarray:
        """Sets the held components of a vector to zero; returns its norm over each body's points."""
        if self.model.supports is not None:
            self.model.supports.project(vector)
        return self._norms(vector)

    def _norms(self, vector: wp.array) -> np.ndarray:
        bodies = self.model.body_slices
        parts = [vector] if len(bodies) == 1 else [vector[points] for points, _ in bodies]
        return np.sqrt([self.model.dot(part, part) for part in parts])

    def linearize(self, u: wp.array, hessian: Hessian) -> None:
        """Makes :attr:`operator` the second derivative at u."""
        friction = None if self.model.contact is None else (self.base, self.duration)
        self.operator.linearize(u, self.weight, hessian=hessian, friction=friction, precondition=True)

    def rounding(self, d: wp.array, u: wp.array) -> tuple[np.ndarray, float]:
        """What cannot be told from rounding: each body's norm of the force that one rounding makes, and its work.

        That of the place at which :meth:`linearize` was last called.
        """
        model = self.model
        arguments = [self.operator.inverse_diagonal, model.mass, self.weight, model.types.epsilon, u, d]
        self._sum.clear()
        self._launch("rounding", arguments, [self.part, self._sum.array])
        work = self._sum.read()
        return self._free_norms(self.part), work

    def longest_step(self, u: wp.array, direction: wp.array, contact_only: bool = False) -> float:
        """1, or nine tenths of what takes the first cell that does not bear inversion from u to J = 0.

        Nor may a point cross an obstacle that it could leave on the other side.
        """
        if self._limit is None:
            return 1.0
        self._limit.fill_(1.0 / 0.9)
        if not contact_only:
            for block in self._barriers:
                block.launch("step_limit", [u, direction], [self._limit])
        if self.model.contact is not None:
            self.model.contact.limit_step(u, direction, self._limit)
        return min(1.0, 0.9 * float(self._limit.numpy()[0]))

    def crosses_an_obstacle(self, u: wp.array, way: wp.array) -> bool:
        """Whether the straight way of a point from u leads through the core of an obstacle."""
        contact = self.model.contact
        if contact is None or not contact.limits_steps:
            return False
        self._limit.fill_(1.0)
        contact.limit_step(u, way, self._limit)
        return float(self._limit.numpy()[0]) < 1.0

    def _launch(self, name: str, inputs: list, outputs: list) -> None:
        self._launcher(getattr(self.kernels, name), self.model.point_count, inputs, outputs)
