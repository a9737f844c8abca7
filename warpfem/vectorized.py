"""Internal forces of cells on the CPU, several cells at a time in vector registers.

One task takes a block of rows (see ``row_blocks.py``), chunk by chunk in a loop over unit-stride data with the rows in
the innermost place, which the compiler turns into vector code of the width that the processor has. A row is a strip of
linear cells (see ``strips.py``) or one quadratic cell: points, and some quadrature points whose deformation gradients
depend on those. What the rows need of points, and exert on them, goes from and to the block's points by loads and
stores of a point each (see ``packed_points.py``), several times as fast as number by number.

What lets the compiler do it: the material's stress has no branches (``Constitutive.branchless``), or one without them
that tells where it holds (``direct_stress``; the remaining cells are then taken one at a time); arrays are seen through
views of length 0 (Warp adds the length to negative indices, and adding 0 needs no test) with strides that are known at
compile time.
"""

import functools
from collections.abc import Callable

import numpy as np
import warp as wp

from warpfem.barrier import Barriers
from warpfem.dtypes import types
from warpfem.elements import ElementKernels
from warpfem.launches import Recordings, jobs
from warpfem.materials.base import Constitutive
from warpfem.packed_points import packed_point_functions
from warpfem.row_blocks import CHUNK, RowBlocks
from warpfem.shapes import Shape
from warpfem.strips import STRIP, cut_into_strips, order_in_space
from warpfem.tensor import select
from warpfem.threads import Job, Team, share
from warpfem.vector_code import MAX_UNROLL, compiler_flags


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
    """Kernel functions that read what the rows of a chunk have from blocked arrays."""

    def __init__(self, width: int, parameter_count: int, dim: int, dtype: str, uniform: bool) -> None:
        t = types(dim, dtype)
        scalar, matrix = t.scalar, t.matrix
        row_vectors = wp.types.matrix(shape=(width, dim), dtype=scalar)
        parameter_vector = wp.types.vector(length=parameter_count, dtype=scalar)

        @wp.func
        def view(blocked: wp.array(dtype=scalar), chunk: int, entries: int):
            """A chunk's part of an array that has some entries of each row."""
            offset = wp.uint64(chunk) * wp.uint64(entries * wp.static(CHUNK * t.numpy().itemsize))
            return wp.array(ptr=blocked.ptr + offset, shape=(0,), dtype=scalar)

        @wp.func
        def row(listed: wp.array(dtype=scalar), lane: int):
            """The vectors of the points of a row, from the components that ``load_rows`` lists."""
            value = row_vectors()
            for a in range(wp.static(width)):
                for i in range(wp.static(dim)):
                    value[a, i] = listed[(a * wp.static(dim) + i) * wp.static(CHUNK) + lane]
            return value

        @wp.func
        def gradients(B: wp.array(dtype=scalar), k: int, lane: int):
            """D_m^-1 [1/m] in place ``k`` of a row."""
            value = matrix()
            for a in range(wp.static(dim)):
                for i in range(wp.static(dim)):
                    value[a, i] = B[((k * wp.static(dim) + a) * wp.static(dim) + i) * wp.static(CHUNK) + lane]
            return value

        @wp.func
        def parameters(p: wp.array(dtype=scalar), k: int, lane: int):
            """The material's there."""
            value = parameter_vector()
            for i in range(wp.static(parameter_count)):
                if wp.static(uniform):
                    value[i] = p[i]
                else:
                    value[i] = p[(k * wp.static(parameter_count) + i) * wp.static(CHUNK) + lane]
            return value

        self.row_vectors = row_vectors
        self.view, self.row, self.gradients, self.parameters = view, row, gradients, parameters


@functools.cache
def _force_kernel(constitutive: Constitutive, shape: Shape, dtype: str, uniform: bool) -> wp.Kernel:
    dim, row = shape.dim, Row(shape)
    t = types(dim, dtype)
    scalar, vector, matrix = t.scalar, t.vector, t.matrix
    width, places, terms = row.width, row.places, row.terms
    points, weights = row.points.tolist(), row.weights.tolist()
    point_table = wp.types.matrix(shape=(places * dim, terms), dtype=wp.int32)(row.points.ravel().tolist())
    weight_table = wp.types.matrix(shape=(places * dim, terms), dtype=scalar)(row.weights.ravel().tolist())
    stress, direct_stress = constitutive.stress, constitutive.direct_stress
    direct = direct_stress is not None
    read = Readers(width, constitutive.parameter_count, dim, dtype, uniform)
    row_vectors, view, read_row = read.row_vectors, read.view, read.row
    read_gradients, read_parameters = read.gradients, read.parameters
    parameter_count = constitutive.parameter_count
    packed = packed_point_functions(dim, dtype, width)
    pack, load_rows, add_rows, unpack = packed.pack, packed.load_rows, packed.add_rows, packed.unpack

    @wp.func
    def internal_forces(
        x: row_vectors,
        B: wp.array(dtype=scalar),
        volumes: wp.array(dtype=scalar),
        p: wp.array(dtype=scalar),
        lane: int,
    ):
        """On the points of a row at their displacements ``x``, and the sum of 2^k over places k of known stress.

        With a direct stress, places where it does not hold exert none, and are left out of what is known.
        """
        f = row_vectors()
        known = scalar(0.0)
        for k in range(wp.static(places)):
            gradients = read_gradients(B, k, lane)
            H = matrix()
            for a in range(wp.static(dim)):
                change = wp.static(scalar(weights[k][a][0])) * x[wp.static(points[k][a][0])]
                for n in range(1, wp.static(terms)):
                    change += wp.static(scalar(weights[k][a][n])) * x[wp.static(points[k][a][n])]
                H += wp.outer(change, gradients[a])
            own = read_parameters(p, k, lane)
            if wp.static(direct):
                P, holds = direct_stress(H, own)
                known += wp.static(scalar(2**k)) * scalar(holds)
                weighted = -volumes[k * wp.static(CHUNK) + lane] * select(holds == 1, P, matrix())
            else:
                weighted = -volumes[k * wp.static(CHUNK) + lane] * stress(H, own)
            for a in range(wp.static(dim)):
                share = weighted * gradients[a]
                for n in range(wp.static(terms)):
                    f[wp.static(points[k][a][n])] += wp.static(scalar(weights[k][a][n])) * share
        return f, known

    @wp.func
    def add_remaining(
        held: int,
        x: wp.array(dtype=scalar),
        B: wp.array(dtype=scalar),
        volumes: wp.array(dtype=scalar),
        p: wp.array(dtype=scalar),
        lane: int,
        f: wp.array(dtype=scalar),
    ):
        """Adds the forces of those places of a row that the direct stress left out, one at a time."""
        table = wp.static(point_table)
        weight = wp.static(weight_table)
        k = int(0)
        while held != wp.static(2**places - 1):
            if (held >> k) % 2 == 0:
                held += 1 << k
                gradients = read_gradients(B, k, lane)
                H = matrix()
                for a in range(wp.static(dim)):
                    change = vector()
                    for n in range(wp.static(terms)):
                        entry = table[k * wp.static(dim) + a, n] * wp.static(dim * CHUNK) + lane
                        for i in range(wp.static(dim)):
                            change[i] += weight[k * wp.static(dim) + a, n] * x[entry + i * wp.static(CHUNK)]
                    H += wp.outer(change, gradients[a])
                weighted = -volumes[k * wp.static(CHUNK) + lane] * stress(H, read_parameters(p, k, lane))
                for a in range(wp.static(dim)):
                    share = weighted * gradients[a]
                    for n in range(wp.static(terms)):
                        entry = table[k * wp.static(dim) + a, n] * wp.static(dim * CHUNK) + lane
                        for i in range(wp.static(dim)):
                            f[entry + i * wp.static(CHUNK)] += weight[k * wp.static(dim) + a, n] * share[i]
            k += 1

    options = {
        "max_unroll": MAX_UNROLL,
        "cpu_compiler_flags": compiler_flags(4, "runtime-memory-check-threshold=64", inlined=30000),
    }

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def block_force(
        first: int,
        chunk_starts: wp.array(dtype=wp.int32),
        point_starts: wp.array(dtype=wp.int32),
        block_points: wp.array(dtype=wp.int32),
        row_points: wp.array(dtype=wp.uint16),
        inverse_shape: wp.array(dtype=scalar),
        volume: wp.array(dtype=scalar),
        parameters: wp.array(dtype=scalar),
        targets: wp.array(dtype=wp.int32),
        u: wp.array(dtype=vector),
        packed_u: wp.array(dtype=scalar),
        packed_force: wp.array(dtype=scalar),
        row_u: wp.array(dtype=scalar),
        row_force: wp.array(dtype=scalar),
        known_out: wp.array(dtype=scalar),
        force_out: wp.array(dtype=vector),
        aside_out: wp.array(dtype=vector),
    ):
        """Adds the internal forces of the rows of block ``first + tid`` to those on their points, or puts them aside.

        ``packed_u`` to ``row_force`` are a thread's scratch; of these ``packed_force`` is 0 before and after.
        """
        block = first + wp.tid()
        begin = point_starts[block]
        end = point_starts[block + 1]
        pack(u, block_points, begin, end, packed_u)
        displacements = wp.array(ptr=row_u.ptr, shape=(0,), dtype=scalar)
        forces = wp.array(ptr=row_force.ptr, shape=(0,), dtype=scalar)
        for chunk in range(chunk_starts[block], chunk_starts[block + 1]):
            load_rows(packed_u, row_points, chunk * wp.static(width * CHUNK), row_u)
            B = view(inverse_shape, chunk, wp.static(places * dim * dim))
            volumes = view(volume, chunk, wp.static(places))
            p = view(parameters, chunk, wp.static(0 if uniform else places * parameter_count))
            known = view(known_out, chunk, 1)
            for lane in range(wp.static(CHUNK)):
                f, holds = internal_forces(read_row(displacements, lane), B, volumes, p, lane)
                for a in range(wp.static(width)):
                    for i in range(wp.static(dim)):
                        forces[(a * wp.static(dim) + i) * wp.static(CHUNK) + lane] = f[a, i]
                if wp.static(direct):
                    known[lane] = holds
            if wp.static(direct):
                for row in range(wp.static(CHUNK)):
                    if known[row] != wp.static(scalar(2**places - 1)):
                        add_remaining(int(known[row]), displacements, B, volumes, p, row, forces)
            add_rows(row_force, row_points, chunk * wp.static(width * CHUNK), packed_force)
        unpack(packed_force, targets, begin, end, force_out, aside_out)

    return block_force


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
        blocks: of chunks of rows.
        cell_arrays: what the rows have of their cells, by chunk: D_m^-1, volumes and parameters.
        scratch: of each thread: displacements of and forces on a block's points, packed, and those of a chunk's rows.
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
        self._kernel = _force_kernel(*made_for)
        if shape.order == 1:
            strips = cut_into_strips(rest_points, host_cells)
            points, quadrature = strips.points, strips.cells
        else:
            order = order_in_space(rest_points, host_cells)
            points = host_cells[order]
            quadrature = order[:, None] * shape.quadrature_count + np.arange(shape.quadrature_count)
        missing = -len(points) % CHUNK
        points = np.pad(points, ((0, missing), (0, 0)), mode="edge")
        quadrature = np.pad(quadrature, ((0, missing), (0, 0)), constant_values=-1)
        real = quadrature >= 0
        if shape.order == 1:
            gradients = self._gradients(host_cells, inverse_shape, points, quadrature)
        else:
            gradients = np.where(real[:, :, None, None], inverse_shape[quadrature], 0.0)
        if not uniform:
            of_cells = parameters[quadrature // shape.quadrature_count]
        self.blocks = RowBlocks(points, dim, dtype, team.size)
        self.cell_arrays = [
            self._chunked(gradients, t.scalar),
            self._chunked(np.where(real, volumes[quadrature], 0.0), t.scalar),
            wp.array(parameters.ravel(), dtype=t.scalar, device="cpu")
            if uniform
            else self._chunked(np.where(real[:, :, None], of_cells, parameters[0]), t.scalar),
        ]
        direct = kernels.constitutive.direct_stress is not None
        self.known = wp.zeros(len(points) if direct else 0, dtype=t.scalar, device="cpu")
        of_rows = points.shape[1] * dim * CHUNK
        self.scratch = [
            [self.blocks.scratch(), self.blocks.scratch(), *(wp.zeros(of_rows, t.scalar, device="cpu") for _ in "uf")]
            for _ in range(team.size)
        ]

    def _chunked(self, rows: np.ndarray, dtype: type) -> wp.array:
        """Rows (count, ...) as one array with those of a chunk innermost."""
        chunks = rows.reshape(len(rows) // CHUNK, CHUNK, -1).transpose(0, 2, 1)
        return wp.array(np.ascontiguousarray(chunks, dtype=wp.dtype_to_numpy(dtype)).ravel(), dtype=dtype, device="cpu")

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
        scratch = [array for own in self.scratch for array in own]
        return [*self.cell_arrays, self.known, *self.blocks.arrays(), *scratch]

    def record(self, u: wp.array, force_out: wp.array) -> list[wp.Launch | None]:
        """The launch of each thread that adds the internal forces at ``u`` to ``force_out``.

        Once all threads are done, those of :meth:`record_aside` are to follow.
        """
        blocks = self.blocks
        shared = [blocks.chunk_starts, blocks.point_starts, blocks.points, blocks.rows, *self.cell_arrays]
        return [
            wp.launch(
                self._kernel,
                len(own),
                inputs=[own.start, *shared, blocks.targets, u, *scratch],
                outputs=[self.known, force_out, blocks.aside],
                device="cpu",
                record_cmd=True,
            )
            for own, scratch in zip(blocks.of_thread, self.scratch, strict=True)
        ]

    def record_aside(self, force_out: wp.array, points: range) -> wp.Launch | None:
        """The launch that then adds what threads have put aside to a range of points; ``None`` for nothing."""
        return self.blocks.record_aside(force_out, points)

    def add(self, u: wp.array, force_out: wp.array) -> None:
        """Adds the internal forces at ``u`` to ``force_out``."""
        run, work = self._recordings.get((u.ptr, force_out.ptr), lambda: self._record(u, force_out))
        run(work)

    def _record(self, u: wp.array, force_out: wp.array) -> tuple[Callable[[list[Job]], None], list[Job]]:
        size = self._team.size
        launches = [[launch] for launch in self.record(u, force_out)]
        if size == 1:
            return self._team.run, jobs(launches, as_graphs=False)
        barriers = Barriers(self._team, 1)
        for thread, (own, points) in enumerate(zip(launches, share(len(force_out), size), strict=True)):
            own += [barriers.record(0, thread), self.record_aside(force_out, points)]
        return barriers.run, jobs(launches)
