"""The reference that tuning measures by: as accurate as the error asked for wants it, and no dearer than it must be."""

from __future__ import annotations

from warpfem.errors import SimulationError
from warpfem.solvers import VelocityVerlet
from warpfem.trade.axes import MeshControl
from warpfem.trade.front import RESOLVED, advice, label, percent
from warpfem.trade.problem import FORCED, Setting
from warpfem.trade.reference import FINE_ALGEBRA, Reference, build_reference
from warpfem.trade.study import Point, Study
from warpfem.trade.trials import with_steps

PRECISE = 0.1
"""The error band of the reference that is aimed at, as a part of the error asked for."""

CHEAP = 10.0
"""Seconds of the coarsest run of a reference below which explicit steps are not compared with others."""

FAVOUR = 3.0
"""Times the cost on the coarsest mesh up to which explicit steps are preferred for references: float64 and three stages
make implicit ones dear, but those need fewer steps on fine meshes."""

EXPLICIT = {f"{FORCED}solver": VelocityVerlet.name, f"{FORCED}dt": "auto"}
"""Explicit steps as long as a mesh allows."""


def reference_within(study: Study, mesh: MeshControl, name: str, target: float) -> tuple[Reference, bool]:
    """A reference that tells errors of a size, and whether it takes explicit steps.

    Args:
        study: runs what it needs.
        mesh: makes meshes finer.
        name: of the norm or quantity that the error is of.
        target: the relative error.

    Raises:
        SimulationError: there is none that is accurate enough.
    """
    start, explicit = beginning(study, mesh)
    how = "explicit" if explicit else "implicit"
    study.say(f"a reference for {percent(target)} of {label(name)}, by {how} steps")
    reference = build_reference(study, mesh, [start], name, within=PRECISE * target, explicit=explicit)
    band = reference.band(name)
    if not band <= RESOLVED * target:
        raise SimulationError(
            f"no setting can be told to be within {percent(target)} of {label(name)}: the reference itself may be off "
            f"by {percent(band)}. {advice(reference, name)}"
        )
    return reference, explicit


def beginning(study: Study, mesh: MeshControl) -> tuple[Point, bool]:
    """The coarsest mesh that can be run, and whether explicit steps make a reference cheaper.

    Raises:
        SimulationError: no mesh can be run.
    """
    for factor in (4, 2, 1):
        base = coarser(mesh, Setting(), factor).changed(**{f"{FORCED}element": "quadratic"})
        (explicit,) = study.solve([base.changed(dtype="float64", **EXPLICIT)])
        if not explicit.failure and explicit.seconds < CHEAP:
            return explicit, True
        fine = base.changed(**FINE_ALGEBRA, **{f"{FORCED}solver": "sdirk3"})
        (implicit,) = study.solve([with_steps(fine, float(study.scene.fps), 2)])
        if not explicit.failure and (implicit.failure or explicit.seconds < FAVOUR * implicit.seconds):
            return explicit, True
        if not implicit.failure:
            return implicit, False
    raise SimulationError(f"there is no reference: {implicit.failure}")


def coarser(mesh: MeshControl, setting: Setting, factor: int) -> Setting:
    """The setting with cells larger by a factor, or as large as there are."""
    while factor > 1:
        found = mesh.finer(setting, 1.0 / factor)
        if found is not None:
            return found
        factor //= 2
    return setting
