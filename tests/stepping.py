"""What the tests of time integration share: small scenes made ready, stepped, and put into dense matrices."""

from collections.abc import Callable
from typing import Any

import numpy as np

from warpfem.materials import LinearElasticity, StableNeoHookean
from warpfem.mesh import Mesh
from warpfem.model import Model, State
from warpfem.scene import Body, Scene
from warpfem.solvers import (
    SDIRK2,
    SDIRK3,
    BackwardEuler,
    ImplicitMidpoint,
    Solver,
    Stepper,
    StepReport,
    SymplecticEuler,
    VelocityVerlet,
)

EXPLICIT = [SymplecticEuler(), VelocityVerlet()]
TIGHT = BackwardEuler(tolerance=1e-10)
LINEARISED = BackwardEuler.linearised(linear_tolerance=1e-13)
MIDPOINT = ImplicitMidpoint(tolerance=1e-10)
SDIRK = [SDIRK2(tolerance=1e-10), SDIRK3(tolerance=1e-10)]
SOLVERS = [*EXPLICIT, TIGHT, LINEARISED, MIDPOINT, *SDIRK]


def solver_name(solver: Solver) -> str:
    """The id of a solver in a parametrised test."""
    return "linearised" if getattr(solver, "max_iterations", 0) == 1 else solver.name


# The two materials that most tests use, so that few kernels are compiled.
MATERIALS = {2: LinearElasticity(E=1e5, nu=0.3), 3: StableNeoHookean(E=1e5, nu=0.3)}


def slab(dim: int, **settings: Any) -> Body:
    """A body of 2 m x 1 m (x 1 m) on the plane y = 0, of a few cells."""
    mesh = Mesh.rectangle((2.0, 1.0), (4, 2)) if dim == 2 else Mesh.box((2.0, 1.0, 1.0), (2, 1, 1))
    return Body("slab", mesh, **{"material": MATERIALS[dim], **settings})


def ready(scene: Scene, dtype: str = "float64") -> tuple[Model, State, Stepper]:
    """A scene's model, its initial state and its stepper."""
    model = Model(scene, device="cpu", dtype=dtype)
    return model, model.state(), scene.solver.stepper(model)


def advance(
    stepper: Stepper, state: State, dt: float, steps: int, after: Callable[[], object] | None = None
) -> list[StepReport]:
    """Steps a state; every step must converge. ``after`` is called after each."""
    reports = []
    for _ in range(steps):
        reports.append(stepper.step(state, dt))
        assert reports[-1].converged, reports[-1]
        if after is not None:
            after()
    return reports


def mean(model: Model, field: np.ndarray) -> np.ndarray:
    """The mean over the mass of a field (point_count, dim)."""
    return model.lumped_mass @ field / model.lumped_mass.sum()


def all_forces(model: Model, state: State) -> np.ndarray:
    """All forces but inertia, damping and friction (point_count, dim)."""
    out = model.zeros()
    model.force(state.u, out)
    return out.numpy().astype(np.float64)


def dense_stiffness(model: Model, state: State | None = None) -> np.ndarray:
    """K of the elements, (point_count dim)^2, summed up by NumPy from the cells'."""
    n, d = model.point_count, model.dim
    K = np.zeros((n, d, n, d))
    for block, stiffness in zip(model.blocks, model.element_stiffness(state and state.u), strict=True):
        for cell, own in zip(block.host_cells, stiffness, strict=True):
            for a, i in enumerate(cell):
                for b, j in enumerate(cell):
                    K[i, :, j, :] += own[a, :, b, :]
    return K.reshape(n * d, n * d)


def modes(model: Model, free: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Angular frequencies, ascending, and modes u (count, point_count, dim) of the linearised model.

    Args:
        model: the model.
        free: mask (point_count, dim) of what may move; ``None`` for all.
    """
    shape = (model.point_count, model.dim)
    index = np.flatnonzero(np.ones(shape, bool) if free is None else free)
    root = np.sqrt(np.repeat(model.lumped_mass, model.dim))[index]
    values, vectors = np.linalg.eigh(dense_stiffness(model)[np.ix_(index, index)] / np.outer(root, root))
    fields = np.zeros((len(index), model.point_count * model.dim))
    fields[:, index] = (vectors / root[:, None]).T
    return np.sqrt(np.maximum(values, 0.0)), fields.reshape(-1, *shape)
