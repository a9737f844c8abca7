"""Free spin: what each solver keeps of the angular momentum."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import warpfem as wf
from verification.core import Case, Check, Table, at_most
from verification.models import body, model_of
from warpfem.model import Model, State
from warpfem.solvers import Solver
from warpfem.solvers.implicit import ImplicitSolver

E, NU, DENSITY = 1e6, 0.3, 1000.0
DT, DURATION = 0.01, 1.0
IMPLICIT = {name: solver(tolerance=1e-8) for name, solver in wf.SOLVERS.items() if issubclass(solver, ImplicitSolver)}
EXPLICIT = {name: solver() for name, solver in wf.SOLVERS.items() if name not in {*IMPLICIT, wf.Quasistatic.name}}
SOLVERS = {**IMPLICIT, "linearised backward Euler": wf.BackwardEuler.linearised(), **EXPLICIT}
KEEPING = {"implicit_midpoint": 1e-6, "symplectic_euler": 1e-11, "velocity_verlet": 1e-11}
"""The largest change of the angular momentum of the solvers that keep it, up to rounding or their tolerance."""


def angular_momentum(model: Model, state: State) -> float:
    """About the z axis through the origin [kg m^2/s]."""
    x = model.rest_points + state.displacement
    v = state.velocity
    return float(model.lumped_mass @ (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]))


def spinning(model: Model, omega: float) -> State:
    """A steady spin: the stretch in which elasticity balances the centrifugal force, for small strain."""
    X, d = model.rest_points, model.dim
    K = np.zeros((model.point_count, d, model.point_count, d))
    for block, stiffness in zip(model.blocks, model.element_stiffness(), strict=True):
        for cell, own in zip(block.host_cells, stiffness, strict=True):
            K[np.ix_(cell, range(d), cell, range(d))] += own
    axis = np.array([1.0, 1.0, 0.0])[:d]
    force = omega**2 * model.lumped_mass[:, None] * X * axis
    u = np.linalg.lstsq(K.reshape(X.size, X.size), force.ravel(), rcond=1e-10)[0].reshape(X.shape)
    x = X + u
    v = np.zeros_like(x)
    v[:, 0], v[:, 1] = -omega * x[:, 1], omega * x[:, 0]
    state = model.state()
    state.assign(displacement=u, velocity=v)
    return state


def backward_euler_share(omega: float, dt: float, steps: int) -> float:
    """What exact backward Euler steps of a rigid body keep of the angular momentum.

    A point at radius R that turns by the angle a in a step has the velocity of the chord, and the angular momentum
    m R^2 sin(a)/dt. Forces within the body have no torque about the end of the step: m x' cross (v' - v) = 0, which
    gives tan(a') = sin(a)/(2 - cos(a)), after tan(a) = omega dt in the first step.
    """
    angle = np.arctan(omega * dt)
    for _ in range(steps - 1):
        angle = np.arctan2(np.sin(angle), 2.0 - np.cos(angle))
    return float(np.sin(angle) / (omega * dt))


def kept(model: Model, solver: Solver, omega: float, dt: float) -> float:
    """The share of the angular momentum that is left at the end."""
    state, stepper = spinning(model, omega), solver.stepper(model)
    start = angular_momentum(model, state)
    for _ in range(round(DURATION / dt)):
        stepper.step(state, dt)
    return angular_momentum(model, state) / start


def run(quick: bool) -> Iterator[Check | Table]:
    rows = []
    for dim in (3,) if quick else (2, 3):
        n = 2 if quick else 3
        corner, kind = (-0.5,) * dim, wf.Mesh.rectangle if dim == 2 else wf.Mesh.box
        mesh = kind((1.0,) * dim, (n,) * dim, origin=corner)
        model = model_of(body(mesh, wf.NeoHookean(E=E, nu=NU), density=DENSITY))
        for omega in (5.0,) if quick else (2.0, 5.0):
            where = f"omega = {omega:g}, {dim}D"
            theory = backward_euler_share(omega, DT, round(DURATION / DT))
            shares = {}
            for name, solver in SOLVERS.items():
                dt = DT
                if name in EXPLICIT:
                    dt = DURATION / np.ceil(DURATION / (0.9 * solver.stepper(model).stable_dt()))
                shares[name] = kept(model, solver, omega, dt)
            yield at_most(f"backward Euler less its theory, {where}", abs(shares["backward_euler"] - theory), 0.001)
            for name, limit in KEEPING.items():
                yield at_most(f"{name}, change of angular momentum, {where}", abs(shares[name] - 1.0), limit)
            rows.append([f"{dim}D", f"{omega:g}", f"{theory:.4f}", *(f"{share:.4f}" for share in shares.values())])
    head = ["", "omega", "theory of backward Euler", *SOLVERS]
    yield Table("Share of the angular momentum after 1 s; dt = 0.01 s for the implicit steps", head, rows)


CASE = Case(
    name="spin",
    title="Free spin",
    what=(
        "A free Neo-Hookean square and cube of 1 m (E = 1e6, nu = 0.3, density 1000) in steady spin with its "
        "centrifugal stretch, for 1 s; explicit steps at 0.9 of their stability limit."
    ),
    reference=(
        "explicit steps keep the angular momentum exactly, since their forces have no torque about the places at which "
        "they are taken, and so does the implicit midpoint rule, as it does all quadratic invariants (Hairer, Lubich "
        "and Wanner, Geometric numerical integration, 2006, theorem IV.2.1); for exact backward Euler steps of a rigid "
        "body tan(a') = sin(a)/(2 - cos(a)) for the angles of two steps (derived in benchmarks/verification/spin.py). "
        "For the others no theory is claimed."
    ),
    criterion=(
        "explicit: kept to 1e-11; implicit midpoint, whose steps are solved to 1e-8: to 1e-6; backward Euler: within "
        "0.001 of the theory."
    ),
    run=run,
)
