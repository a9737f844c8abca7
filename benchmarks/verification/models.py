"""What the cases ask of warpfem: bodies of each kind of element, loads from arrays, static solutions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import warpfem as wf
from warpfem.materials import Material
from warpfem.model import Model, State
from warpfem.scene import ELEMENTS

SEPARATE_ELEMENTS = tuple(element for element in ELEMENTS if element != "averaged")
"""The kinds of elements whose cells are coupled by their points alone."""

ORDERS = {"linear": (2, 1), "quadratic": (3, 2), "averaged": (2, 1)}
"""Order of convergence in L2 and in H1 of smooth solutions."""


def body(mesh: wf.Mesh, material: Material, element: str = "linear", **settings: Any) -> wf.Body:
    """A body of that kind of element."""
    return wf.Body("body", mesh, material, element=element, **settings)


def model_of(bodies: wf.Body | Sequence[wf.Body], **scene: Any) -> Model:
    """The float64 model of bodies on the CPU."""
    listed = [bodies] if isinstance(bodies, wf.Body) else list(bodies)
    return Model(wf.Scene(listed, wf.BackwardEuler(), **scene), device="cpu", dtype="float64")


def solved(model: Model, tolerance: float = 1e-10, start: np.ndarray | None = None) -> State:
    """The static equilibrium, from rest or from displacements ``start`` (n, dim)."""
    state = model.state()
    if start is not None:
        state.assign(displacement=start)
    wf.StaticEquilibrium(tolerance=tolerance).solve(model, state)
    return state


def point_forces(forces: np.ndarray) -> list[wf.PointForce]:
    """One load for each point on which a force (n, dim) [N] acts."""
    return [wf.PointForce([i], forces[i]) for i in np.flatnonzero(forces.any(axis=1))]


def mapped(mesh: wf.Mesh, place: Any) -> wf.Mesh:
    """The mesh with its points (n, dim) moved to ``place(points)``."""
    return wf.Mesh(place(mesh.points), mesh.cells, mesh.point_sets)
