"""Internal forces of cells on the CPU, several cells at a time in vector registers.

One task takes a chunk of rows in a loop over unit-stride data with the rows in the innermost place, which the compiler
turns into vector code of the width that the processor has. A row is a strip of linear cells (see ``strips.py``) or one
quadratic cell: points, and some quadrature points whose deformation gradients depend on those. The forces on the points
of the rows go to an array of their own, from which a second kernel sums them for each point (see ``row_sums.py``).

What lets the compiler do it: the material's stress has no branches (``Constitutive.branchless``), or one without them
that tells where it holds (``direct_stress``; the remaining cells are then taken one at a time); results are kept on
the stack until the loop ends, where they cannot alias its inputs; arrays are seen through views of length 0 (Warp adds
the length to negative indices, and adding 0 needs no test) with strides that are known at compile time.
"""

import functools
from collections.abc import Callable

import numpy as np
import warp as wp

from warpfem.barrier import Barrier
from warpfem.dtypes import types
from warpfem.elements import ElementKernels
from warpfem.launches import Recordings, jobs
from warpfem.materials.base import Constitutive
from warpfem.row_sums import CHUNK, RowSums
from warpfem.shapes import Shape
from warpfem.strips import STRIP, cut_into_strips, order_in_space
from warpfem.tensor import select
from warpfem.threads import Job, Team, share
from warpfem.vector_code import compiler_flags


class Row:
    """What a row of cells of a shape is.

    At a quadrature point of barycentric coordinates lambda, which the cells' corners after the first have, the
    displacements u_n of its points change with lambda_a by the sum of w_n u_n over some of them.

    Attributes:
        width: points.
        places: quadrature points.
        terms: of each of these sums.
        points: (places, dim, terms) int, its n.
        weights: (places, dim, terms) float, its w.
    """

    def __init__(self, shape: Shape) -> None:
        dim = shape.dim
        if shape.order == 1:
            self.width, self.places = STRIP + dim, STRIP
            first = np.arange(STRIP)[:, None]
            self.points = np.stack([*np.broadcast_arrays(first + 1 + np.arange(dim), first)], axis=2)
            self.weights = np.broadcast_to([1.0, -1.0], self.points.shape)
        else:
            self.width, self.places = shape.point_count, shape.quadrature_count
            directions = shape.quadrature_gradients.transpose(0, 2, 1)
            used = directions.any(axis=0)
            self.points = np.broadcast_to([np.flatnonzero(own) for own in used], (self.places, dim, used[0].sum()))
            self.weights = np.take_along_axis(directions, self.points, axis=2)
        self.terms = self.points.shape[2]


class Readers:
    """Kernel functions that read what a row has from blocked arrays."""

    def __init__(self, row: Row, parameter_count: int, dim: int, dtype: str, uniform: bool) -> None:
        t = types(dim, dtype)
        scalar, vector, matrix = t.scalar, t.vector, t.matrix
        parameter_vector = wp.types.vector(length=parameter_count, dtype=scalar)
        width = row.width

        @wp.func
        def displacement(points: wp.array(dtype=wp.int32), u: wp.array(dtype=scalar), chunk: int, a: int, lane: int):
            """Of point ``a`` of a row."""
            offset = points[(chunk * wp.static(width) + a) * wp.static(CHUNK) + lane]
            value = vector()
            for i in range(wp.static(dim)):
                value[i] = u[offset + i]
            return value

        @wp.func
        def gradients(B: wp.array(dtype=scalar), place: int, lane: int):
            """D_m^-1 [1/m]; ``place`` is where the quadrature points of one place in the rows begin."""
            value = matrix()
            for a in range(wp.static(dim)):
                for i in range(wp.static(dim)):
                    value[a, i] = B[place * wp.static(dim * dim) + (a * wp.static(dim) + i) * wp.static(CHUNK) + lane]
            return value

        @wp.func
        def parameters(p: wp.array(dtype=scalar), place: int, lane: int):
            """The material's."""
            value = parameter_vector()
            for i in range(wp.static(parameter_count)):
                if wp.static(uniform):
                    value[i] = p[i]
                else:
                    value[i] = p[place * wp.static(parameter_count) + i * wp.static(CHUNK) + lane]
            return value

        self.displacement, self.gradients, self.parameters = displacement, gradients, parameters


@functools.cache
def _force_kernel(constitutive: Constitutive, shape: Shape, dtype: str, uniform: bool) -> wp.Kernel:
    dim, row = shape.dim, Row(shape)
    t = types(dim, dtype)
    scalar, vector, matrix = t.scalar, t.vector, t.matrix
    width, places, terms = row.width, row.places, row.terms
    points, weights = row.points.tolist(), row.weights.tolist()
    row_vectors = wp.types.matrix(shape=(width, dim), dtype=scalar)
    stress, direct_stress = constitutive.stress, constitutive.direct_stress
    direct = direct_stress is not None
    read = Readers(row, constitutive.parameter_count, dim, dtype, uniform)
    read_displacement, read_gradients, read_parameters = read.displacement, read.gradients, read.parameters

    @wp.func
    def internal_forces(
        x: row_vectors,
        B: wp.array(dtype=scalar),
        volumes: wp.array(dtype=scalar),
        p: wp.array(dtype=scalar),
        chunk: int,
        lane: int,
    ):
        """On the points of a row at their displacements ``x``, and the sum of 2^k over places k of known stress."""
        f = row_vectors()
        known = scalar(0.0)
        for k in range(wp.static(places)):
            place = (chunk * wp.static(places) + k) * wp.static(CHUNK)
            gradients = read_gradients(B, place, lane)
            H = matrix()
            for a in range(wp.static(dim)):
                change = wp.static(scalar(weights[k][a][0])) * x[wp.static(points[k][a][0])]
                for n in range(1, wp.static(terms)):
                    change += wp.static(scalar(weights[k][a][n])) * x[wp.static(points[k][a][n])]
                H += wp.outer(change, gradients[a])
            own = read_parameters(p, place, lane)
            if wp.static(direct):
                P, holds = direct_stress(H, own)
                known += wp.static(scalar(2**k)) * scalar(holds)
                weighted = -volumes[place + lane] * select(holds == 1, P, matrix())
            else:
                weighted = -volumes[place + lane] * stress(H, own)
            for a in range(wp.static(dim)):
                share = weighted * gradients[a]
                for n in range(wp.static(terms)):
                    f[wp.static(points[k][a][n])] += wp.static(scalar(weights[k][a][n])) * share
        return f, known

    flags = compiler_flags(4, inlined=30000)

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": flags})
    def row_force(
        first: int,
        row_points: wp.array(dtype=wp.int32),
        inverse_shape: wp.array(dtype=scalar),
        volume: wp.array(dtype=scalar),
        parameters: wp.array(dtype=scalar),
        u: wp.array(dtype=vector),
        force_out: wp.array(dtype=scalar),
        known_out: wp.array(dtype=scalar),
    ):
        """Writes the internal forces on the points of the rows of chunk ``first + tid`` in place ``tid``.

        With a direct stress, places where it does not hold exert none, and are left out of what is written as known.
        """
        chunk = first + wp.tid()
        own_points = wp.array(ptr=row_points.ptr, shape=(0,), dtype=wp.int32)
        B = wp.array(ptr=inverse_shape.ptr, shape=(0,), dtype=scalar)
        volumes = wp.array(ptr=volume.ptr, shape=(0,), dtype=scalar)
        p = wp.array(ptr=parameters.ptr, shape=(0,), dtype=scalar)
        displacement = wp.array(ptr=u.ptr, shape=(0,), dtype=scalar)
        forces = wp.zeros(shape=(wp.static(width * dim * CHUNK),), dtype=scalar)
        known = wp.zeros(shape=(wp.static(CHUNK),), dtype=scalar)  # integers could alias shapes of arrays
        for lane in range(wp.static(CHUNK)):
            x = row_vectors()
            for a in range(wp.static(width)):
                x[a] = read_displacement(own_points, displacement, chunk, a, lane)
            f, holds = internal_forces(x, B, volumes, p, chunk, lane)
            if wp.static(direct):
                known[lane] = holds
            for a in range(wp.static(width)):
                for i in range(wp.static(dim)):
                    forces[(a * wp.static(dim) + i) * wp.static(CHUNK) + lane] = f[a, i]
        out = wp.array(ptr=force_out.ptr, shape=(0,), dtype=scalar)
        for entry in range(wp.static(width * dim * CHUNK)):
            out[wp.tid() * wp.static(width * dim * CHUNK) + entry] = forces[entry]
        if wp.static(direct):
            for lane in range(wp.static(CHUNK)):
                known_out[chunk * wp.static(CHUNK) + lane] = known[lane]

    return row_force


@functools.cache
def _remainder_kernel(constitutive: Constitutive, shape: Shape, dtype: str, uniform: bool) -> wp.Kernel:
    dim, row = shape.dim, Row(shape)
    t = types(dim, dtype)
    scalar, vector, matrix = t.scalar, t.vector, t.matrix
    width, places, terms = row.width, row.places, row.terms
    point_table = wp.types.matrix(shape=(places * dim, terms), dtype=wp.int32)(row.points.ravel().tolist())
    weight_table = wp.types.matrix(shape=(places * dim, terms), dtype=scalar)(row.weights.ravel().tolist())
    stress = constitutive.stress
    read = Readers(row, constitutive.parameter_count, dim, dtype, uniform)
    read_displacement, read_gradients, read_parameters = read.displacement, read.gradients, read.parameters

    @wp.kernel(module="unique", enable_backward=False)
    def remaining_force(
        first: int,
        row_points: wp.array(dtype=wp.int32),
        inverse_shape: wp.array(dtype=scalar),
        volume: wp.array(dtype=scalar),
        parameters: wp.array(dtype=scalar),
        u: wp.array(dtype=vector),
        force_out: wp.array(dtype=scalar),
        known: wp.array(dtype=scalar),
    ):
        """Adds the forces of those places of chunk ``first + tid`` that the direct stress left out, one at a time."""
        chunk = first + wp.tid()
        displacement = wp.array(ptr=u.ptr, shape=(0,), dtype=scalar)
        points = wp.static(point_table)
        weights = wp.static(weight_table)
        for lane in range(wp.static(CHUNK)):
            held = int(known[chunk * wp.static(CHUNK) + lane])
            k = int(0)
            while held != wp.static(2**places - 1):
                if (held >> k) % 2 == 0:
                    held += 1 << k
                    place = (chunk * wp.static(places) + k) * wp.static(CHUNK)
                    gradients = read_gradients(inverse_shape, place, lane)
                    H = matrix()
                    for a in range(wp.static(dim)):
                        change = vector()
                        for n in range(wp.static(terms)):
                            point = points[k * wp.static(dim) + a, n]
                            x = read_displacement(row_points, displacement, chunk, point, lane)
                            change += weights[k * wp.static(dim) + a, n] * x
                        H += wp.outer(change, gradients[a])
                    weighted = -volume[place + lane] * stress(H, read_parameters(parameters, place, lane))
                    start = wp.tid() * wp.static(width * dim * CHUNK) + lane
                    for a in range(wp.static(dim)):
                        share = weighted * gradients[a]
                        for n in range(wp.static(terms)):
                            weight = weights[k * wp.static(dim) + a, n]
                            target = start + points[k * wp.static(dim) + a, n] * wp.static(dim * CHUNK)
                            for i in range(wp.static(dim)):
                                force_out[target + i * wp.static(CHUNK)] += weight * share[i]
                k += 1

    return remaining_force


class VectorizedForce:
    """The internal force of the cells of one material, in rows.

    Args:
        kernels: the plain kernels of the material.
        host_cells: (count, k) int, the cells' points in the model.
        rest_points: of the model, (point_count, dim) [m].
        inverse_shape: D_m^-1 of each quadrature point, cell by cell, (count * q, dim, dim) [1/m].
        volumes: likewise, (count * q,) [m^3].
        parameters: the material's, (1, k) if uniform, else (count, k).
        team: the threads among which :meth:`add` divides its work.

    Attributes:
        block_count, chunk_count: blocks and chunks of rows.
        uniform: whether all cells have the same parameters.
        known: for a material with a direct stress, for each row the sum of 2^k over those of its quadrature points k
            where it held in the last forces computed.
    """

    def __init__(
        self,
        kernels: ElementKernels,
        host_cells: np.ndarray,
        rest_points: np.ndarray,
        inverse_shape: np.ndarray,
        volumes: np.ndarray,
        parameters: np.ndarray,
        team: Team,
    ) -> None:
        self._team = team
        self._recordings = Recordings()
        t = kernels.types
        shape = kernels.shape
        dim = self.dim = kernels.dim
        dtype = t.name
        self.uniform = uniform = len(parameters) == 1
        made_for = (kernels.constitutive, shape, dtype, uniform)
        self._kernels = [_force_kernel(*made_for)]
        if kernels.constitutive.direct_stress is not None:
            self._kernels.append(_remainder_kernel(*made_for))
        if shape.order == 1:
            strips = cut_into_strips(rest_points, host_cells)
            points, quadrature = strips.points, strips.cells
        else:
            order = order_in_space(rest_points, host_cells)
            points = host_cells[order]
            quadrature = order[:, None] * shape.quadrature_count + np.arange(shape.quadrature_count)
        self.chunk_count = -(-len(points) // CHUNK)
        missing = self.chunk_count * CHUNK - len(points)
        points = np.pad(points, ((0, missing), (0, 0)), mode="edge")
        quadrature = np.pad(quadrature, ((0, missing), (0, 0)), constant_values=-1)
        real = quadrature >= 0
        if shape.order == 1:
            gradients = self._gradients(host_cells, inverse_shape, points, quadrature)
            occupied = np.zeros(points.shape, dtype=bool)
            for k in range(STRIP):
                occupied[:, k : k + dim + 1] |= real[:, k, None]
        else:
            gradients = np.where(real[:, :, None, None], inverse_shape[quadrature], 0.0)
            occupied = np.repeat(real[:, :1], points.shape[1], axis=1)
        if not uniform:
            of_cells = parameters[quadrature // shape.quadrature_count]
        self.arrays_by_name = {
            "row_points": self._blocked(dim * points, wp.int32),
            "inverse_shape": self._blocked(gradients, t.scalar),
            "volume": self._blocked(np.where(real, volumes[quadrature], 0.0), t.scalar),
            "parameters": wp.array(parameters.ravel(), dtype=t.scalar, device="cpu")
            if uniform
            else self._blocked(np.where(real[:, :, None], of_cells, parameters[0]), t.scalar),
        }
        self.known = wp.zeros(len(points) if len(self._kernels) == 2 else 0, dtype=t.scalar, device="cpu")
        self._sums = RowSums(points, occupied, dim, dtype, team.size)
        self.block_count = len(self._sums.chunks)

    def _blocked(self, rows: np.ndarray, dtype: type) -> wp.array:
        """Rows (count, ...) as one array with those of a chunk innermost."""
        blocks = rows.reshape(self.chunk_count, CHUNK, -1).transpose(0, 2, 1)
        return wp.array(np.ascontiguousarray(blocks, dtype=wp.dtype_to_numpy(dtype)).ravel(), dtype=dtype, device="cpu")

    def _gradients(
        self, host_cells: np.ndarray, inverse_shape: np.ndarray, points: np.ndarray, cells: np.ndarray
    ) -> np.ndarray:
        """D_m^-1 (count, STRIP, dim, dim) with the corners of each cell in the order of its strip; 0 for none."""
        result = np.zeros((*cells.shape, self.dim, self.dim))
        gradients = np.concatenate([-inverse_shape.sum(axis=1, keepdims=True), inverse_shape], axis=1)
        for k in range(STRIP):
            rows = np.flatnonzero(cells[:, k] >= 0)
            own = cells[rows, k]
            corners = points[rows, k + 1 : k + 1 + self.dim]
            places = (corners[:, :, None] == host_cells[own][:, None, :]).argmax(axis=2)
            result[rows, k] = gradients[own[:, None], places]
        return result

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        return [*self.arrays_by_name.values(), self.known, *self._sums.arrays()]

    def record(self, u: wp.array, force_out: wp.array) -> list[list[wp.Launch | None]]:
        """The launches of each thread that add the internal forces at ``u`` to ``force_out``, in their order.

        Once all threads are done, those of :meth:`record_aside` are to follow.
        """
        return [self._record_blocks(thread, u, force_out) for thread in range(self._team.size)]

    def _record_blocks(self, thread: int, u: wp.array, force_out: wp.array) -> list[wp.Launch | None]:
        launches = []
        for block in self._sums.blocks[thread]:
            chunks = self._sums.chunks[block]
            inputs = [chunks.start, *self.arrays_by_name.values(), u]
            outputs = [self._sums.scratch[thread], self.known]
            for kernel in self._kernels:
                launch = wp.launch(kernel, len(chunks), inputs=inputs, outputs=outputs, device="cpu", record_cmd=True)
                launches.append(launch)
            launches.append(self._sums.record_block(block, thread, force_out))
        return launches

    def record_aside(self, force_out: wp.array, points: range) -> wp.Launch | None:
        """The launch that then adds what threads have put aside to a range of points; ``None`` for nothing."""
        return self._sums.record_aside(force_out, points)

    def add(self, u: wp.array, force_out: wp.array) -> None:
        """Adds the internal forces at ``u`` to ``force_out``."""
        key = (u.ptr, force_out.ptr, wp.get_device("cpu").is_capturing)
        run, work = self._recordings.get(key, lambda: self._record(u, force_out))
        run(work)

    def _record(self, u: wp.array, force_out: wp.array) -> tuple[Callable[[list[Job]], None], list[Job]]:
        size = self._team.size
        launches = self.record(u, force_out)
        if size == 1:
            return self._team.run, jobs(launches, as_graphs=not wp.get_device("cpu").is_capturing)
        barrier = Barrier(self._team)
        for own, points in zip(launches, share(len(force_out), size), strict=True):
            own += [barrier.record(), self.record_aside(force_out, points)]
        return barrier.run, jobs(launches)
