"""A solver for Newton (https://github.com/newton-physics/newton): the tetrahedra of its models, stepped by warpfem."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpfem.dtypes import FloatName, types
from warpfem.errors import MissingExtraError, SceneError, SimulationError
from warpfem.materials import HookeanMaterial, StableNeoHookean
from warpfem.model import Model
from warpfem.solvers import BackwardEuler
from warpfem.solvers.base import Solver, StepReport

try:
    import newton
except ImportError as error:
    raise MissingExtraError("warpfem.interop.newton", "newton", "newton") from error

from warpfem.interop.newton_solid import read_solid


@functools.cache
def _kernels(dtype: str) -> SimpleNamespace:
    t = types(3, dtype)
    vector, scalar = t.vector, t.scalar
    module = f"warpfem.interop.newton_{dtype}"

    @wp.kernel(module=module, enable_backward=False)
    def read(
        particles: wp.array(dtype=wp.int32),
        rest: wp.array(dtype=wp.vec3),
        mass: wp.array(dtype=scalar),
        q: wp.array(dtype=wp.vec3),
        qd: wp.array(dtype=wp.vec3),
        f: wp.array(dtype=wp.vec3),
        world: wp.array(dtype=wp.int32),
        gravity: wp.array(dtype=wp.vec3),
        u_out: wp.array(dtype=vector),
        v_out: wp.array(dtype=vector),
        load_out: wp.array(dtype=vector),
        changed_out: wp.array(dtype=wp.int32),
    ):
        """Takes over what differs from the positions, velocities and loads of the last step."""
        i = wp.tid()
        p = particles[i]
        changed = int(0)
        # vectors have no != in Warp
        if not (q[p] == wp.vec3(vector(rest[i]) + u_out[i])):  # noqa: SIM201
            u_out[i] = vector(q[p]) - vector(rest[i])
            changed = 1
        if not (qd[p] == wp.vec3(v_out[i])):  # noqa: SIM201
            v_out[i] = vector(qd[p])
            changed = 1
        w = world[p]
        if w < 0:  # of no world: the last entry is for these
            w = gravity.shape[0] - 1
        load = mass[i] * vector(gravity[w]) + vector(f[p])
        if not (load == load_out[i]):  # noqa: SIM201
            load_out[i] = load
            changed = 1
        if changed == 1:
            changed_out[0] = 1

    @wp.kernel(module=module, enable_backward=False)
    def hold_here(points: wp.array(dtype=wp.int32), u: wp.array(dtype=vector), target_out: wp.array(dtype=vector)):
        """Makes the displacements of held points those where they are held."""
        k = wp.tid()
        target_out[k] = u[points[k]]

    @wp.kernel(module=module, enable_backward=False)
    def write(
        particles: wp.array(dtype=wp.int32),
        rest: wp.array(dtype=wp.vec3),
        u: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        q_out: wp.array(dtype=wp.vec3),
        qd_out: wp.array(dtype=wp.vec3),
    ):
        i = wp.tid()
        p = particles[i]
        q_out[p] = wp.vec3(vector(rest[i]) + u[i])
        qd_out[p] = wp.vec3(v[i])

    return SimpleNamespace(read=read, hold_here=hold_here, write=write)


class SolverWarpfem(newton.solvers.SolverBase):
    """Steps the tetrahedra of a Newton model by a warpfem solver.

    ``k_mu`` and ``k_lambda`` of each tetrahedron are taken for what Newton's documentation and its USD importer call
    them, the Lame parameters [Pa],

        k_mu = E / (2 (1 + nu)),    k_lambda = E nu / ((1 + nu) (1 - 2 nu)),

    and every material obeys Hooke's law at rest for this E and nu. So does Newton's ``SolverVBD``;
    ``SolverSemiImplicit`` puts the two numbers into the energy of Smith, de Goes and Kim (2018, eq. 13) as they are,
    which makes it a solid of mu = 3/4 k_mu and lambda = k_lambda - 5/8 k_mu.

    The rest shape is ``model.particle_q`` when the solver is made. Masses are ``particle_mass``: ``add_soft_mesh``
    shares that of the tetrahedra among them, while ``add_soft_grid`` gives each particle that of a whole cell of the
    grid. Gravity and ``state_in.particle_f`` act as they are at each step. Particles without mass or not ``ACTIVE``
    are held where ``state_in`` has them: to move them, write their positions. Planes, spheres and boxes that do not
    move, and that collide with particles, are obstacles in all worlds, whether or not contacts are given, with the
    friction sqrt(soft_contact_mu mu); surfaces touch them, without ``particle_radius`` between. What warpfem has no
    counterpart for is warned of when the solver is made, and stays as it is: cloth, springs, rigid bodies, ``k_damp``.
    Later changes of the model, except of its gravity, want a new solver.

    Steps decide on the host how they go on, and cannot be captured as a graph.

    Args:
        model: the Newton model.
        solver: a warpfem solver without an error target, for example ``wf.VelocityVerlet()``.
        material: the law whose parameters are ``k_mu`` and ``k_lambda``.
        dtype: "float32" or "float64". Between steps displacements keep the digits that ``particle_q`` has no room for.
        threads: threads of the CPU that steps may use; ``None`` takes all cores.

    Attributes:
        solid: the warpfem model; its points are numbered by :attr:`particles`.
        state: displacements and velocities at the end of the last step, for questions to :attr:`solid`.
        particles: the particle of each point of :attr:`solid`, (point_count,) int32 device array.
        report: how the last step went.

    Raises:
        SceneError: the model has no tetrahedra, is deformed, or the solver chooses its time steps.
        MeshError: the tetrahedra are no mesh that warpfem can take.
        MaterialError: the parameters of a tetrahedron are those of no stable solid.
    """

    def __init__(
        self,
        model: newton.Model,
        solver: Solver | None = None,
        material: type[HookeanMaterial] = StableNeoHookean,
        *,
        dtype: FloatName = "float32",
        threads: int | None = None,
    ) -> None:
        super().__init__(model)
        read = read_solid(model, solver or BackwardEuler(), material)
        self.solid = Model(read.scene, device=str(model.device), dtype=dtype, threads=threads, lumped_mass=read.masses)
        self._stepper = read.scene.solver.stepper(self.solid)
        if self._stepper.controls_error:
            raise SceneError(
                "a solver with an error target chooses its time steps, which Newton does here: leave it out"
            )
        self._kernels = _kernels(dtype)
        self.state = self.solid.state()
        self.particles = wp.array(read.particles, dtype=wp.int32, device=model.device)
        self._rest = wp.array(model.particle_q.numpy()[read.particles], dtype=wp.vec3, device=model.device)
        self._changed = wp.zeros(1, dtype=wp.int32, device=model.device)
        self.report = StepReport()

    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        *,
        observables: Any = None,
    ) -> None:
        """Writes what becomes of ``state_in`` within ``dt`` [s] to ``state_out``; they may be the same.

        Args:
            state_in: positions and velocities of the particles, and the forces on them [N].
            state_out: gets positions and velocities; what the solver does not move is copied.
            control: not used.
            contacts: not used: the solver finds contact with obstacles itself.
            dt: time step [s].
            observables: not used.

        Raises:
            SimulationError: the step cannot be taken, and ``state_out`` is as it was.
        """
        if self.model.device.is_capturing:
            raise SimulationError(
                "steps of warpfem cannot be captured as a graph: they decide on the host how they go on. Call step() "
                "outside of wp.ScopedCapture"
            )
        self._read(state_in)
        self.report = self._stepper.step(self.state, float(dt))
        if state_out is not state_in:
            for name in ("particle_q", "particle_qd", "body_q", "body_qd", "joint_q", "joint_qd"):
                if getattr(state_in, name) is not None:
                    wp.copy(getattr(state_out, name), getattr(state_in, name))
        self._launch("write", [self._rest, self.state.u, self.state.v], [state_out.particle_q, state_out.particle_qd])

    def _read(self, state: newton.State) -> None:
        model, solid, own = self.model, self.solid, self.state
        self._changed.zero_()
        given = [state.particle_q, state.particle_qd, state.particle_f, model.particle_world, model.gravity]
        self._launch("read", [self._rest, solid.mass, *given], [own.u, own.v, solid.dead_load, self._changed])
        if not self._changed.numpy()[0]:
            return
        own.revision += 1
        if solid.supports is not None:
            supports = solid.supports
            wp.launch(
                self._kernels.hold_here,
                supports.count,
                inputs=[supports.points, own.u],
                outputs=[supports.target],
                device=model.device,
            )

    def _launch(self, name: str, inputs: list, outputs: list) -> None:
        wp.launch(
            getattr(self._kernels, name),
            len(self.particles),
            inputs=[self.particles, *inputs],
            outputs=outputs,
            device=self.model.device,
        )
