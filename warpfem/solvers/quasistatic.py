"""Motion without inertia: one equilibrium after the other."""

from dataclasses import dataclass

from warpfem.model import Model, State
from warpfem.solvers.base import Solver, Stepper, StepReport, require_positive
from warpfem.solvers.newton import NewtonSettings
from warpfem.solvers.static import LINEAR_ITERATIONS, StaticNewton, require_solvable


@dataclass(frozen=True)
class Quasistatic(NewtonSettings, Solver):
    """Each step ends in the equilibrium that descent leads to from the last one, with supports where they are then.

    For motion so slow that inertia does not matter, and for the state in which damping lets bodies come to rest. Loads
    act in full from the first step on; velocities and damping do not matter. As of :class:`StaticEquilibrium`, bodies
    need supports against rigid motion, and obstacles have no friction.
    """

    linear_iterations: int = LINEAR_ITERATIONS

    name = "quasistatic"
    order = 0

    def stepper(self, model: Model) -> Stepper:
        return _QuasistaticStepper(model, self)


class _QuasistaticStepper(Stepper):
    """Steps from equilibrium to equilibrium.

    Raises:
        SceneError: a body can move freely, or an obstacle has friction.
    """

    def __init__(self, model: Model, config: Quasistatic) -> None:
        require_solvable(model)
        self.model = model
        self.newton = StaticNewton(model, config, static=True)
        self._found: tuple[State, int] | None = None  # state and revision that are an equilibrium

    @property
    def linear_solver(self) -> str:
        return str(self.newton.linear)

    def arrays(self) -> list:
        return self.newton.arrays()

    def step(self, state: State, dt: float) -> StepReport:
        require_positive(dt)
        time = state.time + dt
        supports = self.model.supports
        assert supports is not None  # without, bodies can move freely
        supports.advance(time, dt)
        report = StepReport()
        if supports.moving or self._found != (state, state.revision):
            report = self.newton.solve(state)
            self.newton.accept(state, time)
        state.time = time
        self._found = state, state.revision
        return report
