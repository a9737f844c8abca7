"""What the device needs for exactly one scene (Model), and what changes while it runs (State)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import prod
from typing import TYPE_CHECKING, Literal

import numpy as np
import warp as wp

from warpfem.boundary import PointForce, Traction
from warpfem.dtypes import FloatName, part_of, types, uniform_array
from warpfem.elements import ElementKernels, element_kernels
from warpfem.errors import SceneError, SimulationError
from warpfem.launches import Launcher, Total
from warpfem.materials import Constitutive, HookeanMaterial
from warpfem.mesh import Mesh
from warpfem.points import chunks, point_kernels
from warpfem.scene import Body, Scene
from warpfem.shapes import Shape
from warpfem.stiffness import all_blocks, entry_count
from warpfem.strips import STRIP
from warpfem.threads import CELLS_PER_THREAD, Team, available_threads

if TYPE_CHECKING:
    from warpfem.contact import Contact
    from warpfem.supports import Supports
    from warpfem.vectorized import VectorizedForce

Route = Literal["tape", "closed", "assembled"]

STIFFNESS_PART = 16384
"""Cells whose dense stiffness is held at a time: 19 MB for tetrahedra, where that of a million takes 1.2 GB."""


class State:
    """What changes during a simulation.

    Attributes:
        u: displacements of all bodies' points, (point_count,) vectors [m], Warp array.
        v: velocities [m/s], likewise.
        time: simulated time [s].
        revision: counts changes of ``u`` and ``v``; steppers that remember something about a state compare
            it. :meth:`assign` advances it; after writing to ``u`` or ``v`` yourself, add 1.
    """

    def __init__(self, u: wp.array, v: wp.array, time: float = 0.0) -> None:
        self.u = u
        self.v = v
        self.time = time
        self.revision = 0

    def assign(self, *, displacement: np.ndarray | None = None, velocity: np.ndarray | None = None) -> None:
        """Overwrites displacements [m] or velocities [m/s], arrays (point_count, dim).

        Raises:
            SimulationError: if one of them has another shape or is not finite; nothing is changed then.
        """
        arrays = []
        for target, name, value in ((self.u, "displacement", displacement), (self.v, "velocity", velocity)):
            if value is not None:
                array = _point_vectors(f"the {name} of a state", value, (target.shape[0], target.dtype._length_))
                arrays.append((target, array.astype(wp.dtype_to_numpy(target.dtype._wp_scalar_type_))))
        for target, array in arrays:
            target.assign(array)
        self.revision += 1

    def copy(self) -> State:
        """An independent copy."""
        return State(wp.clone(self.u), wp.clone(self.v), self.time)

    @property
    def displacement(self) -> np.ndarray:
        """Displacements, a float64 copy (point_count, dim) [m]."""
        return self.u.numpy().astype(np.float64)

    @property
    def velocity(self) -> np.ndarray:
        """Velocities, a float64 copy (point_count, dim) [m/s]."""
        return self.v.numpy().astype(np.float64)


@dataclass(frozen=True)
class Energies:
    """Energies of a state [J] (2D: per metre of thickness).

    Attributes:
        kinetic: sum of m |v|^2 / 2.
        elastic: volume-weighted energy density; infinite if a cell of a barrier material has J <= 0.
        load: potential of gravity and dead loads, 0 at rest shape; gravity is shared as in :attr:`Model.dead_load`.
        contact: penalty energy of the obstacles.
    """

    kinetic: float
    elastic: float
    load: float
    contact: float

    @property
    def total(self) -> float:
        """The sum [J]."""
        return self.kinetic + self.elastic + self.load + self.contact


@dataclass(frozen=True, eq=False)
class Stresses:
    """Stresses at every quadrature point as float64 arrays (k, 3, 3) [Pa]; plane strain has its normal stress.

    A linear cell has one quadrature point, so that k = cell_count where all cells are linear; a quadratic one has
    dim + 1, one after another.

    Attributes:
        deformation_gradient: F; in 2D diag(F, 1).
        first_piola_kirchhoff: P = dpsi/dF, force per rest area.
        cells: the cell of each quadrature point, (k,).
        points: rest places of the quadrature points, (k, dim) [m].
        volumes: their parts of the rest volume, (k,) [m^3].
        small_strain: whether the material is linear elasticity, which knows one stress alone, (k,) bool.
        kirchhoff: tau = P F^T; P at small strain.
        cauchy: sigma = tau / J, force per current area; P at small strain.
        jacobian: J = det F, (k,).
        von_mises: sqrt(3/2) |dev sigma|, (k,) [Pa].
    """

    deformation_gradient: np.ndarray
    first_piola_kirchhoff: np.ndarray
    cells: np.ndarray
    points: np.ndarray
    volumes: np.ndarray
    small_strain: np.ndarray

    @cached_property
    def jacobian(self) -> np.ndarray:
        return np.linalg.det(self.deformation_gradient)

    @cached_property
    def kirchhoff(self) -> np.ndarray:
        tau = self.first_piola_kirchhoff @ self.deformation_gradient.transpose(0, 2, 1)
        return np.where(self.small_strain[:, None, None], self.first_piola_kirchhoff, tau)

    @cached_property
    def cauchy(self) -> np.ndarray:
        return self.kirchhoff / np.where(self.small_strain, 1.0, self.jacobian)[:, None, None]

    @cached_property
    def von_mises(self) -> np.ndarray:
        pressure = np.trace(self.cauchy, axis1=1, axis2=2) / 3.0
        deviator = self.cauchy - pressure[:, None, None] * np.eye(3)
        return np.sqrt(1.5 * np.einsum("cij,cij->c", deviator, deviator))


class CellBlock:
    """The cells of the bodies that share a material's kernels, on the device.

    Attributes:
        kernels: the kernels of the material.
        shape: shape of the cells.
        index: the cells' numbers in the model, (count,) int.
        count: cells.
        arguments: device arrays ``cells, inverse_shape, volume, parameters`` by name; the second and the third have
            an entry for each quadrature point, cell by cell.
        averaged: whether the cells are coupled beyond their points: then it is an ``AveragedBlock``.
        vectorized: what computes the internal force several cells at a time, once :meth:`vectorize` has made it.
        bounding_kernels: kernels by which the stiffness of the whole is at most the sum over the cells.
    """

    averaged = False

    def __init__(self, kernels: ElementKernels, parts: list[tuple[Body, int, int]], device) -> None:
        t = kernels.types
        meshes = [body.mesh for body, _, _ in parts]
        self.kernels = self.bounding_kernels = kernels
        self.shape = kernels.shape
        self.device = device
        self._launch = Launcher(device)
        self.vectorized: VectorizedForce | None = None
        self.count = sum(mesh.cell_count for mesh in meshes)
        self.index = np.concatenate([start + np.arange(b.mesh.cell_count) for b, _, start in parts])
        self.host_cells = np.concatenate([start + body.mesh.cells for body, start, _ in parts])
        rows = [self._parameter_rows(body) for body, _, _ in parts]
        if len(rows) == 1 and len(rows[0]) == 1:
            parameters = uniform_array(rows[0], self.count, kernels.parameter_vector, device)
        else:
            table = [np.broadcast_to(r, (m.cell_count, r.shape[1])) for r, m in zip(rows, meshes, strict=True)]
            parameters = wp.array(np.concatenate(table), dtype=kernels.parameter_vector, device=device)
        self.arguments = {
            "cells": wp.array(self.host_cells, dtype=kernels.cell_type, device=device),
            "inverse_shape": wp.array(
                np.concatenate([mesh.inverse_shape_matrices for mesh in meshes]),
                dtype=t.matrix,
                device=device,
            ),
            "volume": wp.array(
                np.concatenate([mesh.quadrature_volumes for mesh in meshes]), dtype=t.scalar, device=device
            ),
            "parameters": parameters,
        }

    def _parameter_rows(self, body: Body) -> np.ndarray:
        return body.material.parameter_rows(body.mesh.cell_count)

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        own = [] if self.vectorized is None else self.vectorized.arrays()
        return [*self.arguments.values(), *own]

    def vectorize(self, rest_points: np.ndarray, least: int, team: Team) -> None:
        """Prepares the force of several cells at a time, where that is possible and there are ``least`` quadrature
        points."""
        constitutive = self.kernels.constitutive
        # a GPU has lanes of its own, and adds to points by atomics, which it does well
        possible = self.device.is_cpu and not self.averaged
        possible = possible and (constitutive.branchless or constitutive.direct_stress is not None)
        if self.vectorized or not possible or len(self.arguments["volume"]) < least:
            return
        from warpfem.vectorized import VectorizedForce

        parameters = self.arguments["parameters"]
        self.vectorized = VectorizedForce(
            self.kernels,
            self.host_cells,
            rest_points,
            self.arguments["inverse_shape"].numpy(),
            self.arguments["volume"].numpy(),
            parameters.numpy()[: 1 if parameters.strides[0] == 0 else None],
            team,
        )

    def add_force(self, u: wp.array, force_out: wp.array) -> None:
        """Adds the internal forces -dU/du [N] at ``u`` to ``force_out``."""
        if self.vectorized is None:
            self.launch("force", [u], [force_out])
        else:
            self.vectorized.add(u, force_out)

    def launch(
        self,
        name: str,
        inputs: list,
        outputs: list,
        *,
        part: slice | None = None,
        kernels: ElementKernels | None = None,
        record: bool = False,
    ) -> wp.Launch | None:
        """Launches the kernel of that name over the quadrature points of the cells, or of a part of them.

        Of :attr:`arguments` it gets first those that it names. Those of frequency and stiffness run over cells. With
        ``record`` it returns the launch instead.
        """
        kernel = getattr(kernels or self.kernels, name)
        arrays = self.arguments if part is None else self._arguments_of(part)
        own = [arrays[argument.label] for argument in kernel.adj.args if argument.label in arrays]
        by_cell = name == "frequency" or name.endswith("stiffness")
        tasks = len(arrays["cells"]) if by_cell else len(arrays["volume"])
        if record or name.startswith("taped"):
            return wp.launch(
                kernel, tasks, inputs=[*own, *inputs], outputs=outputs, device=self.device, record_cmd=record
            )
        self._launch(kernel, tasks, [*own, *inputs], outputs)
        return None

    def _arguments_of(self, part: slice) -> dict[str, wp.array]:
        places = self.shape.quadrature_count
        inner = slice(part.start * places, part.stop * places)
        by_cell = ("cells", "parameters")
        return {name: part_of(array, part if name in by_cell else inner) for name, array in self.arguments.items()}

    def per_cell(self, values: np.ndarray) -> np.ndarray:
        """Values of the quadrature points (k, ...) as an array (count, q, ...)."""
        return values.reshape(self.count, self.shape.quadrature_count, *values.shape[1:])


class Model:
    """A scene made ready for one device and precision.

    What describes the scene does not change; the targets of prescribed motions and the friction limits of the
    current step are kept here too, so that a model serves one run at a time.

    Points and cells of all bodies are numbered through in the order of the scene's bodies. A term that the
    scene lacks is ``None`` here: it has no array and no kernel.

    Args:
        scene: the scene.
        device: Warp device; ``None`` takes Warp's default.
        dtype: "float32" or "float64".
        threads: threads of the CPU that steps may use; ``None`` takes all cores.
        lumped_mass: mass of each point [kg], (point_count,) float64 > 0, in place of what the densities give; they
            should not give a point more than that, since stability limits are those of the cells.

    Attributes:
        scene: the scene.
        device: Warp device.
        dtype: "float32" or "float64".
        threads: threads of the CPU that steps may use; the results do not depend on them.
        types: the Warp types.
        point_count, cell_count, quadrature_count: points, cells and their quadrature points, totals over the bodies.
        point_starts, cell_starts: first point and cell of each body, with the total at the end.
        mass: lumped mass of each point [kg], device array.
        inverse_mass: its inverse.
        blocks: the cells by material.
        dead_load: gravity and constant loads on each point [N], device array, or ``None``.
        supports: held points, or ``None``.
        contact: obstacles, or ``None``.

    Raises:
        SceneError: if the scene refers to something that does not exist or contradicts itself.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        device: str | None = None,
        dtype: FloatName = "float32",
        threads: int | None = None,
        lumped_mass: np.ndarray | None = None,
    ) -> None:
        if not isinstance(scene, Scene):
            raise SceneError(f"a model is made of a warpfem.Scene, not of {scene!r}")
        self.scene = scene
        self.dtype = dtype
        self.threads = available_threads() if threads is None else _require_threads(threads)
        self.dim = scene.dim
        self.types = types(scene.dim, str(dtype))
        try:
            self.device = wp.get_device(device)
        except (RuntimeError, ValueError, TypeError) as error:
            known = ", ".join(str(known.alias) for known in wp.get_devices())
            raise SceneError(f"no device '{device}': there is {known}") from error
        _require_resolved(scene, self.types.epsilon, dtype)
        meshes = [body.mesh for body in scene.bodies]
        self.point_starts = np.concatenate([[0], np.cumsum([mesh.point_count for mesh in meshes])])
        self.cell_starts = np.concatenate([[0], np.cumsum([mesh.cell_count for mesh in meshes])])
        self.point_count = int(self.point_starts[-1])
        self.cell_count = int(self.cell_starts[-1])
        self.quadrature_count = sum(mesh.cell_count * mesh.shape.quadrature_count for mesh in meshes)
        self.host_mass = _lumped_mass(scene) if lumped_mass is None else lumped_mass
        self.mass = self._device_array(self.host_mass, self.types.scalar)
        self.inverse_mass = self._device_array(1.0 / self.host_mass, self.types.scalar)
        self.blocks = self._cell_blocks()
        load = _dead_load(scene, self.host_mass, self.point_starts)
        self.dead_load = None if load is None else self._device_array(load, self.types.vector)
        self.supports = self._supports()
        self.contact = self._contact()
        self._sum = Total(self.device)
        self._launch = Launcher(self.device)

    # --- finalising -------------------------------------------------------------------------------------

    def _device_array(self, data: np.ndarray, dtype: type) -> wp.array:
        return wp.array(data, dtype=dtype, device=self.device)

    def _cell_blocks(self) -> list[CellBlock]:
        parts: dict[tuple, list[tuple[Body, int, int]]] = {}
        for body, point_start, cell_start in zip(self.scene.bodies, self.point_starts, self.cell_starts, strict=False):
            key = body.material.constitutive, body.mesh.shape, body.element == "averaged"
            parts.setdefault(key, []).append((body, int(point_start), int(cell_start)))
        return [self._cell_block(*key, bodies) for key, bodies in parts.items()]

    def _cell_block(
        self, constitutive: Constitutive, shape: Shape, averaged: bool, bodies: list[tuple[Body, int, int]]
    ) -> CellBlock:
        if averaged:
            from warpfem.averaged import AveragedBlock

            return AveragedBlock(constitutive, bodies, self.dtype, self.device)
        return CellBlock(element_kernels(constitutive, shape, self.dtype), bodies, self.device)

    def _supports(self) -> Supports | None:
        if not any(body.supports for body in self.scene.bodies):
            return None
        from warpfem.supports import Supports

        return Supports(self.scene.bodies, self.point_starts[:-1], self.dim, self.dtype, self.device)

    def _contact(self) -> Contact | None:
        if not self.scene.obstacles:
            return None
        from warpfem.contact import Contact, ContactSurface

        scene, starts = self.scene, self.point_starts[:-1]
        surface = ContactSurface(scene.bodies, starts, self._p_wave_moduli(), scene.gravity, self.dtype, self.device)
        return Contact(self.scene.obstacles, surface, self._slip_speed(), self.dtype)

    def _p_wave_moduli(self) -> list[float]:
        """The largest P-wave modulus of each body at rest [Pa], d²psi/dF_xx² at F = I."""
        bodies = self.scene.bodies
        if all(isinstance(body.material, HookeanMaterial) for body in bodies):
            return [float(np.max(body.material.moduli.p_wave)) for body in bodies]
        # from each cell's own stiffness: the uniform stretch u = X_x e_x has the energy V/2 d²psi/dF_xx²
        modulus = np.zeros(self.cell_count)
        rest, volume = self.rest_points, np.concatenate([body.mesh.cell_volumes for body in bodies])
        u = self.zeros()
        for block in self.blocks:
            for part, stiffness in self.element_stiffness_parts(block, u):
                stretch = np.zeros(stiffness.shape[:3])
                points = rest[block.host_cells[part], 0]
                stretch[..., 0] = points - points[:, :1]
                work = np.einsum("cai,caibj,cbj->c", stretch, stiffness, stretch)
                modulus[block.index[part]] = work / volume[block.index[part]]
        return [float(modulus[cells].max()) for _, cells in self.body_slices]

    def _slip_speed(self) -> float:
        """1e-3 of the speed sqrt(g L) of a fall by the smallest body's size L; without gravity, 1e-3 L per second."""
        size = min(float(np.linalg.norm(np.ptp(body.mesh.bounding_box, axis=0))) for body in self.scene.bodies)
        gravity = 0.0 if self.scene.gravity is None else float(np.linalg.norm(self.scene.gravity))
        return 1e-3 * (np.sqrt(gravity * size) if gravity > 0.0 else size)

    # --- questions about a state ------------------------------------------------------------------------

    def state(self) -> State:
        """The initial state of the scene."""
        u = np.concatenate([body.initial_displacement() for body in self.scene.bodies])
        v = np.concatenate([body.initial_velocity() for body in self.scene.bodies])
        state = State(self._device_array(u, self.types.vector), self._device_array(v, self.types.vector))
        if self.supports is not None:
            self.supports.advance(0.0, 0.0)
            self.supports.hold(state.u, state.v)
        return state

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        own = [self.mass, self.inverse_mass, *(array for block in self.blocks for array in block.arrays())]
        if self.dead_load is not None:
            own.append(self.dead_load)
        for term in (self.supports, self.contact):
            if term is not None:
                own += term.arrays()
        return own

    def zeros(self) -> wp.array:
        """A new vector of zeros per point."""
        return wp.zeros(self.point_count, dtype=self.types.vector, device=self.device)

    @cached_property
    def team(self) -> Team:
        """The threads that steps use, as many as the cells are worth."""
        return Team(max(1, min(self.threads, self.quadrature_count // CELLS_PER_THREAD)) if self.device.is_cpu else 1)

    @cached_property
    def static_load(self) -> wp.array | None:
        """Gravity and constant loads [N] for states of rest, device array, or ``None``: gravity by shape functions.

        :attr:`dead_load` shares gravity among the points as it does mass, so that bodies fall without being strained,
        which costs accuracy where quadratic cells are held. In linear cells the two are the same.
        """
        if self.scene.gravity is None or all(body.mesh.order == 1 for body in self.scene.bodies):
            return self.dead_load
        load = _dead_load(self.scene, _integrated_mass(self.scene), self.point_starts)
        return self._device_array(load, self.types.vector)

    @cached_property
    def body_slices(self) -> list[tuple[slice, slice]]:
        """The ranges of points and of cells of each body."""
        points, cells = self.point_starts.tolist(), self.cell_starts.tolist()
        return [(slice(*a), slice(*b)) for a, b in zip(pairwise(points), pairwise(cells), strict=True)]

    @property
    def rest_points(self) -> np.ndarray:
        """Rest positions of all points, (point_count, dim) float64 [m]."""
        return np.concatenate([body.mesh.points for body in self.scene.bodies])

    @property
    def lumped_mass(self) -> np.ndarray:
        """Lumped mass of each point, (point_count,) float64 [kg]."""
        return self.host_mass.copy()

    def dot(self, a: wp.array, b: wp.array) -> float:
        """a . b over all points, summed in float64."""
        self._sum.clear()
        kernel = point_kernels(self.dim, self.dtype).dot
        self._launch(kernel, chunks(a.shape[0]), [a, b], [self._sum.array])
        return self._sum.read()

    def elastic_energy(self, u: wp.array) -> float:
        """U(u) [J], summed in float64."""
        self._sum.clear()
        for block in self.blocks:
            block.launch("energy", [u], [self._sum.array])
        return self._sum.read()

    def energy_densities(self, state: State) -> np.ndarray:
        """The energy density psi of every cell, its mean if quadratic, (cell_count,) float64 [J/m^3], 0 at rest.

        Infinite where a cell of a material that does not bear inversion has J <= 0.
        """
        psi = np.empty(self.cell_count)
        for block in self.blocks:
            volume = block.arguments["volume"]
            out = wp.zeros_like(volume)
            block.launch("density", [state.u], [out])
            weights = block.per_cell(volume.numpy().astype(np.float64))
            psi[block.index] = (weights * block.per_cell(out.numpy())).sum(axis=1) / weights.sum(axis=1)
        return psi

    def contact_energy(self, u: wp.array) -> float:
        """Penalty energy of the obstacles [J]."""
        if self.contact is None:
            return 0.0
        self._sum.clear()
        self.contact.add_energy(u, self._sum.array)
        return self._sum.read()

    def energies(self, state: State) -> Energies:
        """All energies of a state [J]."""
        self._sum.clear()
        kernel = point_kernels(self.dim, self.dtype).kinetic_energy
        wp.launch(
            kernel,
            chunks(self.point_count),
            inputs=[self.mass, state.v],
            outputs=[self._sum.array],
            device=self.device,
        )
        kinetic = self._sum.read()
        load = 0.0 if self.dead_load is None else 0.0 - self.dot(self.dead_load, state.u)
        return Energies(kinetic, self.elastic_energy(state.u), load, self.contact_energy(state.u))

    def add_internal_force(self, u: wp.array, force_out: wp.array) -> None:
        """Adds the internal forces -dU/du [N] at ``u`` to ``force_out``."""
        for block in self.blocks:
            block.add_force(u, force_out)

    def force(self, u: wp.array, force_out: wp.array) -> None:
        """Overwrites ``force_out`` with all forces but inertia, damping and friction [N]."""
        self.external_force(u, force_out)
        self.add_internal_force(u, force_out)

    def external_force(self, u: wp.array, force_out: wp.array) -> None:
        """Overwrites ``force_out`` with dead loads and the forces of obstacles [N]."""
        self.reset_force(force_out, range(self.point_count))
        if self.contact is not None:
            self.contact.add_force(u, force_out)

    def reset_force(self, force_out: wp.array, points: range) -> None:
        """Overwrites ``force_out`` with dead loads [N] on a range of points."""
        own = slice(points.start, points.stop)
        if self.dead_load is None:
            force_out[own].zero_()
        else:
            wp.copy(force_out[own], self.dead_load[own])

    def vectorize(self, least: int) -> None:
        """Prepares the forces of steps on the CPU: of several cells at a time, where a material has ``least`` of them.

        A quadratic cell counts by its quadrature points. Fewer are not worth the seconds that the compiler takes the
        first time.
        """
        for block in self.blocks:
            block.vectorize(self.rest_points, least, self.team)

    def describe_forces(self) -> str:
        """How :meth:`add_internal_force` computes them, and on how many threads."""
        together = [block for block in self.blocks if block.vectorized]
        if not together:
            return "one cell at a time, on one thread"
        strips = sum(block.count for block in together if block.shape.order == 1)
        quadratic = sum(block.count for block in together if block.shape.order == 2)
        kinds = [f"{strips} cells in strips of {STRIP}"] if strips else []
        kinds += [f"{quadratic} quadratic cells"] if quadratic else []
        plain = self.cell_count - strips - quadratic
        others = f", {plain} others one at a time" if plain else ""
        team = "1 thread" if self.team.size == 1 else f"{self.team.size} threads"
        return f"{' and '.join(kinds)}, several at a time in vector registers{others}; {team}"

    def internal_force(self, state: State) -> np.ndarray:
        """Internal forces -dU/du of a state, (point_count, dim) float64 [N]."""
        out = self.zeros()
        self.add_internal_force(state.u, out)
        return out.numpy().astype(np.float64)

    def force_differential(self, state: State, direction: np.ndarray, route: Route = "closed") -> np.ndarray:
        """The change of the internal force along a direction: df = -K(u) p, with K = d²U/du².

        Args:
            state: where K is taken.
            direction: p, (point_count, dim) [m].
            route: "closed", each material's closed form, matrix-free; "tape", ``wp.Tape`` over the force
                kernel; "assembled", through the block-sparse K. They agree to rounding, but for an
                :class:`EnergyMaterial`, whose differential is a central difference.

        Returns:
            df, (point_count, dim) float64 [N].
        """
        from warpfem.linear import tangent_operator

        vectors = _point_vectors("the direction", direction, (self.point_count, self.dim))
        p = self._device_array(vectors, self.types.vector)
        operator = tangent_operator(self, route, external=False)
        operator.linearize(state.u, mass_weight=0.0)
        out = self.zeros()
        operator.apply(p, out)
        return -out.numpy().astype(np.float64)

    def element_stiffness(self, u: wp.array | None = None) -> list[np.ndarray]:
        """Tangent stiffness of each cell at ``u`` (default: at rest).

        Returns:
            For each block of :attr:`blocks` a float64 array (count, k, d, k, d) [N/m] for cells of k points,
            indexed by point and component of the force, then of the displacement. That of an averaged cell is what
            it would have if its volume change were its own: the whole has less than the sum.
        """
        if u is None:
            u = self.zeros()
        return [
            np.concatenate([stiffness for _, stiffness in self.element_stiffness_parts(block, u)])
            for block in self.blocks
        ]

    def element_stiffness_parts(self, block: CellBlock, u: wp.array) -> Iterator[tuple[slice, np.ndarray]]:
        """:meth:`element_stiffness` of a block a part of the cells at a time, which takes little memory.

        Yields:
            The range of the cells in the block, and their stiffness.
        """
        d = self.dim
        corners = block.shape.point_count
        most = STIFFNESS_PART * (d + 1) ** 2 // corners**2
        for start in range(0, block.count, most):
            part = slice(start, min(start + most, block.count))
            count = part.stop - start
            values = wp.empty(entry_count(count, corners), dtype=self.types.matrix, device=self.device)
            block.launch("stiffness", [u], [values], part=part, kernels=block.bounding_kernels)
            yield part, all_blocks(values.numpy(), count, corners).transpose(0, 1, 3, 2, 4)

    def stresses(self, state: State) -> Stresses:
        """Deformation gradients and stresses at every quadrature point: one per linear cell, dim + 1 per quadratic."""
        solid = wp.types.matrix(shape=(3, 3), dtype=self.types.scalar)
        places = np.empty(self.cell_count, dtype=np.int64)
        for block in self.blocks:
            places[block.index] = block.shape.quadrature_count
        starts = np.concatenate([[0], np.cumsum(places)])
        count = int(starts[-1])
        P, F = np.empty((count, 3, 3)), np.tile(np.eye(3), (count, 1, 1))
        points, volumes = np.empty((count, self.dim)), np.empty(count)
        small_strain = np.empty(count, dtype=bool)
        u, rest = state.displacement, self.rest_points
        for block in self.blocks:
            own = (starts[block.index][:, None] + np.arange(block.shape.quadrature_count)).ravel()
            volume = block.arguments["volume"]
            out = wp.zeros(len(volume), dtype=solid, device=self.device)
            block.launch("stress", [state.u], [out])
            P[own], volumes[own] = out.numpy(), volume.numpy()
            small_strain[own] = block.kernels.constitutive.small_strain
            corners = u[block.host_cells]
            B = block.per_cell(block.arguments["inverse_shape"].numpy().astype(np.float64))
            gradients = np.einsum("qak,cqkj->cqaj", block.shape.quadrature_gradients, B)
            H = np.einsum("cai,cqaj->cqij", corners - corners[:, :1], gradients)
            F[own, : self.dim, : self.dim] += H.reshape(-1, self.dim, self.dim)
            values = block.shape.values(block.shape.quadrature_places)
            points[own] = np.einsum("qa,cai->cqi", values, rest[block.host_cells]).reshape(-1, self.dim)
        return Stresses(F, P, np.repeat(np.arange(self.cell_count), places), points, volumes, small_strain)

    def nodal_stresses(self, state: State) -> np.ndarray:
        """Cauchy stresses at the points, recovered from those in the cells about them (see ``recovery.py``).

        They are smooth in each body: where its material changes from cell to cell, the cells' own tell more.

        Returns:
            (point_count, 3, 3) float64 [Pa].
        """
        from warpfem.recovery import recover

        stresses = self.stresses(state)
        result = np.empty((self.point_count, 3, 3))
        for body, (points, cells) in zip(self.scene.bodies, self.body_slices, strict=True):
            mesh = body.mesh
            own = (stresses.cells >= cells.start) & (stresses.cells < cells.stop)
            result[points] = recover(
                mesh.points,
                mesh.cells,
                mesh.boundary_points,
                stresses.points[own],
                stresses.cells[own] - cells.start,
                stresses.cauchy[own],
                degree=mesh.order,
            )
        return result

    def tractions(self, state: State, body: int = 0) -> np.ndarray:
        """Cauchy traction sigma n [Pa] on every boundary face of a body in its current shape.

        On quadratic faces it is that at the centroid, from the linear function through the cell's quadrature points.

        Args:
            state: the state.
            body: number of the body in the scene.

        Returns:
            (face_count, dim) float64, in the order of the mesh's ``boundary_faces``.
        """
        mesh = self.scene.bodies[body].mesh
        stresses = self.stresses(state)
        own = (stresses.cells >= self.cell_starts[body]) & (stresses.cells < self.cell_starts[body + 1])
        weights = mesh.shape.face_weights[mesh.face_sides]

        def at_faces(values: np.ndarray) -> np.ndarray:
            per_cell = values[own].reshape(mesh.cell_count, -1, 3, 3)
            return np.einsum("fq,fqij->fij", weights, per_cell[mesh.face_cells])

        normals = np.zeros((len(weights), 3))
        normals[:, : self.dim] = mesh.boundary_face_normals
        F = at_faces(stresses.deformation_gradient)
        nominal = np.einsum("fij,fj->fi", at_faces(stresses.first_piola_kirchhoff), normals)  # per rest area
        if self.scene.bodies[body].material.constitutive.small_strain:
            return nominal[:, : self.dim]
        inverse_transpose = np.linalg.inv(F).transpose(0, 2, 1)
        area_ratio = np.linalg.det(F) * np.linalg.norm(np.einsum("fij,fj->fi", inverse_transpose, normals), axis=1)
        return (nominal / area_ratio[:, None])[:, : self.dim]

    def diagnostics(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """J and von Mises stress [Pa] of every cell, float64 arrays (cell_count,).

        Of the quadrature points of a quadratic cell it is the least J and the mean stress.
        """
        jacobian = np.empty(self.cell_count)
        von_mises = np.empty(self.cell_count)
        for block in self.blocks:
            J, stress = wp.zeros_like(block.arguments["volume"]), wp.zeros_like(block.arguments["volume"])
            block.launch("diagnostics", [state.u], [J, stress])
            jacobian[block.index] = block.per_cell(J.numpy()).min(axis=1)
            von_mises[block.index] = block.per_cell(stress.numpy()).mean(axis=1)
        return jacobian, von_mises

    def body_of_cell(self, cell: int) -> tuple[Body, int]:
        """The body that a cell of the model belongs to, and the cell's number in its mesh."""
        body = int(np.searchsorted(self.cell_starts, cell, side="right")) - 1
        return self.scene.bodies[body], int(cell - self.cell_starts[body])

    def body_of_point(self, point: int) -> tuple[Body, int]:
        """The body that a point of the model belongs to, and the point's number in its mesh."""
        body = int(np.searchsorted(self.point_starts, point, side="right")) - 1
        return self.scene.bodies[body], int(point - self.point_starts[body])


def _require_threads(threads: int) -> int:
    if isinstance(threads, bool) or not isinstance(threads, int) or threads < 1:
        raise SceneError(f"threads must be a whole number from 1 on, not {threads!r}")
    return threads


def _point_vectors(what: str, value: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise SimulationError(f"{what} must be numbers of shape {shape}, not {value!r}") from None
    if array.shape != shape:
        raise SimulationError(f"{what} must have shape {shape} for this model, not {array.shape}")
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        raise SimulationError(f"{what} is not finite at point {int(np.argmax(bad))} ({int(bad.sum())} in all)")
    return array


def _require_resolved(scene: Scene, epsilon: float, dtype: str) -> None:
    """Refuses cells so thin that displacements of a body's size cannot tell their points apart."""
    for body in scene.bodies:
        mesh = body.mesh
        B = mesh.inverse_shape_matrices
        last = -B.sum(axis=1)
        squares = np.maximum(np.einsum("cij,cij->ci", B, B).max(axis=1), np.einsum("ci,ci->c", last, last))
        steepest = np.sqrt(squares)
        size = float(np.linalg.norm(np.ptp(mesh.bounding_box, axis=0)))
        thin = np.flatnonzero(steepest * (10.0 * epsilon * size) > 1.0)
        if len(thin):
            advice = "remesh" if dtype == "float64" else 'take dtype="float64", or remesh'
            raise SceneError(
                f"body '{body.name}': cell {thin[0] // mesh.shape.quadrature_count} is {1.0 / steepest[thin[0]]:.2g} m "
                f"high ({len(thin)} such cells): "
                f"{dtype} resolves no less than {10.0 * epsilon * size:.2g} m in a body of {size:.3g} m: {advice}"
            )


def _lumped_mass(scene: Scene) -> np.ndarray:
    """Each cell's mass shared among its points."""
    return _shared_mass(scene, lambda mesh: mesh.shape.mass_shares)


def _integrated_mass(scene: Scene) -> np.ndarray:
    """The integral of density times the shape function of each point; at the corners of quadratic cells it is <= 0."""

    def shares(mesh: Mesh) -> np.ndarray:
        volumes = mesh.quadrature_volumes.reshape(mesh.cell_count, -1) / mesh.cell_volumes[:, None]
        return volumes @ mesh.shape.values(mesh.shape.quadrature_places)

    return _shared_mass(scene, shares)


def _shared_mass(scene: Scene, shares: Callable[[Mesh], np.ndarray]) -> np.ndarray:
    """The mass of each point [kg], from its shares in the cells, (k,) for all cells or (cell_count, k)."""
    masses = []
    for body in scene.bodies:
        mesh = body.mesh
        parts = (body.density * mesh.cell_volumes)[:, None] * shares(mesh)
        masses.append(np.bincount(mesh.cells.ravel(), parts.ravel(), mesh.point_count))
    return np.concatenate(masses)


def _dead_load(scene: Scene, mass: np.ndarray, point_starts: np.ndarray) -> np.ndarray | None:
    """Gravity, point forces and tractions as one force per point [N]; None if there is none of them."""
    if scene.gravity is None and not any(body.loads for body in scene.bodies):
        return None
    load = np.zeros((len(mass), scene.dim))
    if scene.gravity is not None:
        load += mass[:, None] * np.asarray(scene.gravity, dtype=np.float64)
    for body, start in zip(scene.bodies, point_starts, strict=False):
        for term in body.loads:
            where = f"body '{body.name}', {type(term).__name__}"
            if not isinstance(term, PointForce | Traction):
                raise SceneError(f"body '{body.name}': {term!r} is not a PointForce or Traction")
            value = np.asarray(term.force if isinstance(term, PointForce) else term.traction)
            if value.shape != (scene.dim,):
                raise SceneError(f"{where}: {value.tolist()} must have {scene.dim} components in this scene")
            try:
                if isinstance(term, PointForce):
                    load[start + body.mesh.select_points(term.points)] += value
                    continue
                faces = body.mesh.select_faces(term.points)
            except ValueError as error:
                raise SceneError(f"{where}: {error}") from None
            shares = body.mesh.boundary_face_shares[faces]
            np.add.at(load, start + body.mesh.boundary_faces[faces], shares[:, :, None] * value)
    return load


def device_bytes(arrays: list[wp.array]) -> int:
    """Bytes that device arrays really hold: a uniform array counts its one entry."""
    total = 0
    for array in arrays:
        stored = array if array.size == 0 or any(array.strides) else array._stored
        total += prod(stored.shape) * wp.types.type_size_in_bytes(stored.dtype)
    return total
