"""Uniaxial, equibiaxial, planar and shear responses of every material at stretches of 0.1 to 10."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import warpfem as wf
from verification.core import Case, Check, Table, at_most
from verification.models import model_of, solved
from verification.principal import CLOSED_FORMS, MODES, free_stretch, stretches
from warpfem.materials import HookeanMaterial

STRETCHES = (0.1, 0.2, 0.35, 0.5, 0.7, 0.9, 1.1, 1.5, 2.0, 3.0, 5.0, 10.0)
SHEARS = (0.1, 0.3, 1.0, 3.0, 10.0)
Setting = tuple[str, float, float]
"""A mode, the given stretch and the free stretch of the closed form."""

OFFSET = 1.03
"""Factor of the free stretches at which static solves start."""


def simplex(dim: int) -> wf.Mesh:
    """One cell with a corner at the origin and unit edges along the axes."""
    return wf.Mesh(np.concatenate([np.zeros((1, dim)), np.eye(dim)]), [range(dim + 1)])


def evaluated(material: HookeanMaterial, F: np.ndarray) -> np.ndarray:
    """P (n, 3, 3) by the kernels at deformation gradients F (n, d, d)."""
    n, dim, _ = F.shape
    points = np.concatenate([np.zeros((1, dim)), np.eye(dim)])
    mesh = wf.Mesh(np.tile(points, (n, 1)), np.arange(n * (dim + 1)).reshape(n, dim + 1))
    model = model_of(wf.Body("cells", mesh, material))
    state = model.state()
    state.assign(displacement=(np.einsum("nij,kj->nki", F, points) - points).reshape(-1, dim))
    return model.stresses(state).first_piola_kirchhoff


def equilibrated(material: HookeanMaterial, settings: list[Setting], dim: int) -> np.ndarray:
    """One cell for each setting in static equilibrium.

    Returns:
        (n, 2): the nominal stress along axis 1 and the free stretch.
    """
    mesh = simplex(dim)
    bodies, starts, free_axis = [], [], []
    for number, (mode, given, free) in enumerate(settings):
        s = np.array(stretches(mode, given, OFFSET * free)[:dim])
        axes = {"uniaxial": (1, 2), "equibiaxial": (2,), "planar": (1,)}[mode]
        goal = np.eye(dim) * s

        def move(rest, time, goal=goal):
            return rest @ goal

        # corner k may only move along axis k - 1, and there only if that stretch is free
        supports = [wf.Pin([0])]
        for axis in range(dim):
            own = [i for i in range(dim) if not (i == axis and axis in axes)]
            supports.append(wf.PrescribedMotion([axis + 1], move, axes=own))
        bodies.append(wf.Body(f"{number}", mesh, material, supports=supports))
        starts.append(mesh.points @ goal - mesh.points)
        free_axis.append(axes[0])
    model = model_of(bodies)
    state = solved(model, tolerance=1e-11, start=np.concatenate(starts))
    stresses = model.stresses(state)
    F, P = stresses.deformation_gradient, stresses.first_piola_kirchhoff
    return np.stack([P[:, 0, 0], F[np.arange(len(F)), free_axis, free_axis]], axis=1)


def run(quick: bool) -> Iterator[Check | Table]:
    rows = []
    for name in ("linear", "neo_hookean") if quick else tuple(CLOSED_FORMS):
        for nu in (0.3,) if quick else (0.0, 0.3, 0.49):
            material = wf.MATERIALS[name](E=1.0, nu=nu)
            where = f"{name}, nu = {nu:g}"
            for dim in (2, 3):
                yield from _by_evaluation(material, f"{where}, {dim}D", dim)
            for mode in MODES:
                moduli = float(material.mu), float(material.lam)
                roots = [(mode, s, free_stretch(name, mode, s, *moduli)) for s in STRETCHES]
                settings = [(mode, s, root) for mode, s, root in roots if root is not None]
                rows.append([name, f"{nu:g}", mode, f"{settings[0][1]:g} to {settings[-1][1]:g}"])
                for dim in (2, 3) if mode == "planar" else (3,):
                    yield _by_equilibrium(material, settings, f"{mode}, {where}, {dim}D", dim)
    yield Table(
        "Stretches of 0.1 to 10 that have a stable equilibrium of positive stretches",
        ["material", "nu", "mode", "stretches"],
        rows,
    )


def _by_evaluation(material: HookeanMaterial, where: str, dim: int) -> Iterator[Check]:
    """P at given stretches and shears, whether there is an equilibrium or not."""
    form, mu, lam = CLOSED_FORMS[material.name], float(material.mu), float(material.lam)
    triples = [(a, b, 1.0 if dim == 2 else 1.7) for a in STRETCHES for b in STRETCHES]
    found = evaluated(material, np.array([np.diag(s[:dim]) for s in triples]))[:, range(3), range(3)]
    expected = np.array([[form.principal((s[i], *(s[:i] + s[i + 1 :])), mu, lam) for i in range(3)] for s in triples])
    error = np.abs(found - expected).max(axis=1) / np.abs(expected).max(axis=1)
    yield at_most(f"P at 144 pairs of stretches, {where}", float(error.max()), 1e-12)
    sheared = np.tile(np.eye(dim), (len(SHEARS), 1, 1))
    sheared[:, 0, 1] = SHEARS
    found = evaluated(material, sheared)[:, :2, :2]
    expected = np.array([form.shear(g, mu, lam) for g in SHEARS])
    error = np.abs(found - expected).max(axis=(1, 2)) / np.abs(expected).max(axis=(1, 2))
    yield at_most(f"P in simple shear of 0.1 to 10, {where}", float(error.max()), 1e-12)


def _by_equilibrium(material: HookeanMaterial, settings: list[Setting], where: str, dim: int) -> Check:
    """The free stretch and the stress of cells in static equilibrium."""
    form = CLOSED_FORMS[material.name]
    found = equilibrated(material, settings, dim)
    expected = np.array(
        [
            (form.principal(stretches(mode, given, free), float(material.mu), float(material.lam)), free)
            for mode, given, free in settings
        ]
    )
    error = np.abs(found - expected) / np.maximum(np.abs(expected), 1e-3)
    return at_most(f"stress and free stretch at equilibrium, {where}", float(error.max()), 1e-8)


CASE = Case(
    name="homogeneous",
    title="Homogeneous deformations of every material",
    what=(
        "One cell of each material, E = 1: P at all pairs of 12 stretches from 0.1 to 10 and at simple shears up to "
        "10; and its static equilibrium where one or two stretches are given and the others are free (uniaxial, "
        "equibiaxial, planar: in 2D plane strain and in 3D with the third stretch held at 1)."
    ),
    reference=(
        "P_i = d psi/d s_i by hand from the energies that the materials' docstrings cite, in principal stretches; the "
        "free stretch by bisection, followed from rest."
    ),
    criterion="P agrees to 1e-12 of its largest entry; free stretch and stress of the equilibrium to 1e-8.",
    run=run,
)
