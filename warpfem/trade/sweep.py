"""The study of a scene: all settings of some axes, their errors against a reference, and what follows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from warpfem.errors import SceneError, SimulationError
from warpfem.trade.axes import Axis, MeshControl, settings_of
from warpfem.trade.components import Errors, components
from warpfem.trade.front import Answer, Candidate, answer, candidates, front
from warpfem.trade.problem import Problem, Setting
from warpfem.trade.reference import L2, LARGEST, Reference, build_reference
from warpfem.trade.study import Point, Study
from warpfem.trade.tuning_reference import beginning

TARGETS = (0.1, 0.01, 0.001)
"""Relative errors that are answered if none is asked for."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """A finished study.

    Attributes:
        study: what ran it.
        axes: what was varied.
        name: of the norm or quantity that the front is about.
        points: all settings, in the order of the axes.
        reference: what their errors are against; ``None`` if there is none.
        refusal: why there is none.
        ordered: the settings without failure from fast to slow, with their errors.
        front: those that no other one beats.
        parts: the parts of the errors of each setting of the front.
        answers: to each error asked for.
    """

    study: Study
    axes: list[Axis]
    name: str
    points: list[Point]
    reference: Reference | None
    refusal: str
    ordered: list[Candidate]
    front: list[Candidate]
    parts: list[dict[str, Errors]]
    answers: list[Answer]

    @property
    def failed(self) -> list[Point]:
        """The settings without result."""
        return [point for point in self.points if point.failure]


def require_quantity(problem: Problem, name: str) -> None:
    """Raises SceneError unless a name is that of a norm or a quantity of the scene, and not of both."""
    quantities = problem.build(Setting()).scene.quantities
    for norm in (L2, LARGEST):
        if norm in quantities:
            raise SceneError(f"a quantity cannot be called '{norm}': that is a norm of the motion")
    known = [L2, LARGEST, *quantities]
    if name not in known:
        raise SceneError(f"there is no quantity '{name}': the scene has {', '.join(map(repr, known))}")


def sweep(
    study: Study,
    axes: Sequence[Axis],
    mesh: MeshControl,
    *,
    name: str = L2,
    targets: Sequence[float] = TARGETS,
    repeats: int = 3,
) -> Sweep:
    """Runs a study.

    Args:
        study: runs settings.
        axes: what to vary.
        mesh: how the scene's mesh is made finer.
        name: of what to measure the error: "l2", "max" or a quantity of the scene.
        targets: relative errors to answer for.
        repeats: processes for each setting.

    Raises:
        SceneError: there is no such quantity.
        OutputError: something cannot be stored, or the cluster is lost.
    """
    require_quantity(study.problem, name)
    settings = settings_of(axes, study.problem)
    points = study.run(settings)
    reference, refusal = None, ""
    ordered: list[Candidate] = []
    try:
        _, explicit = beginning(study, mesh)
        reference = build_reference(study, mesh, points, name, min(targets), explicit=explicit)
    except SimulationError as error:
        refusal = str(error)
    points = study.run(settings, repeats)
    if reference is not None:
        ordered = candidates(points, reference, name)
    edge = front(ordered)
    parts: list[dict[str, Errors]] = []
    answers: list[Answer] = []
    if reference is not None:
        parts = components(study, mesh, reference, [own.point for own in edge])
        answers = [answer(ordered, reference, name, target) for target in targets]
    return Sweep(study, list(axes), name, points, reference, refusal, ordered, edge, parts, answers)
