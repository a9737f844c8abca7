"""The reference of a study: finer in space and time than what is asked about, extrapolated, with an error band.

Two ladders of runs, in float64 and with a tight tolerance, of quadratic cells and a scheme of third order: one of
meshes with a fixed time step, one of time steps with the coarsest of these meshes. Each is extrapolated, and the sum of
the limit in space and of what is missing in time is the reference; how that depends on the mesh, the second mesh tells.
The ladders grow until the reference is four times as accurate as the best setting, or the next run would take too long.

Explicit steps are as long as each mesh allows: their errors fall with those of the mesh, and one ladder does.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from warpfem.errors import SimulationError
from warpfem.trade.axes import MeshControl
from warpfem.trade.ladders import LadderSum, Part, Rung
from warpfem.trade.outcome import Outcome
from warpfem.trade.problem import FORCED, Setting
from warpfem.trade.study import Difference, Point, Study, difference

MARGIN = 4.0
"""How many times as accurate as the best setting the reference shall be."""

FINE_ALGEBRA = {"dtype": "float64", f"{FORCED}tolerance": "1e-8"}
COARSE_TOLERANCE = "1e-6"

L2, LARGEST = "l2", "max"
"""The two norms over the trajectory, among the names of what errors are measured of."""

MOST_LEVELS = 9
"""Levels of a ladder beyond which a finer one is not the answer."""

DEFAULT_STIFFNESS = (
    "the stiffness of obstacles, where the scene gives none, goes with the size of the cells: bodies sink in less on "
    "finer meshes, and the motion changes by that, too"
)

LEAST_CHANGE = 0.95
"""Part of the mesh size down to which a mesh has to go to be a finer one."""


@dataclass(frozen=True, eq=False)
class Reference:
    """A solution that others are measured by.

    Attributes:
        outcome: its motion and quantities.
        scales: what errors are relative to, by name: the peak over time of the root mean square displacement, the
            largest displacement [m], and the quantities' own magnitudes.
        parts: error bands by name and by what leaves them: "space", "time" and "algebra".
        ladders: what was run for it, by "space" and "time", from coarse to fine. The first mesh of the one, with the
            last but one step of the other, is the run that both share.
        limits: the limit of each ladder: in space with that step, in time with that mesh.
        remarks: what kept it from being more accurate.
    """

    outcome: Outcome
    scales: dict[str, float]
    parts: dict[str, dict[str, Part]]
    ladders: dict[str, list[Rung]]
    limits: dict[str, Outcome]
    remarks: list[str] = field(default_factory=list)

    @property
    def names(self) -> list[str]:
        """What errors can be measured of: the two norms, and the quantities."""
        return list(self.scales)

    def band(self, name: str) -> float:
        """The error band of the reference, relative."""
        return sum(part.band for part in self.parts[name].values())

    def errors(self, outcome: Outcome) -> dict[str, float]:
        """The relative errors of an outcome by name; a quantity that it has no value of has none."""
        return relative(difference(outcome, self.outcome), self.scales)


def relative(own: Difference, scales: dict[str, float]) -> dict[str, float]:
    """A difference over what errors are relative to, by name."""
    absolute = {L2: own.l2, LARGEST: own.largest, **{name: abs(value) for name, value in own.quantities.items()}}
    return {name: absolute[name] / scale for name, scale in scales.items() if name in absolute and scale > 0.0}


def build_reference(
    study: Study,
    mesh: MeshControl,
    asked: Sequence[Point],
    name: str = L2,
    least: float = 0.0,
    *,
    within: float | None = None,
    explicit: bool,
) -> Reference:
    """The reference of settings that have been run.

    Args:
        study: runs what the ladders need.
        mesh: makes meshes finer.
        asked: the settings that it has to be more accurate than; the ladders begin with the coarsest of their meshes.
        name: of what: a norm, or a quantity of the scene.
        least: the smallest relative error that matters: that of a number can be nothing by accident.
        within: the error band to reach, whatever the errors of the settings are; ``None`` for a part of these.
        explicit: whether its runs take explicit steps, as long as each mesh allows.

    Raises:
        SimulationError: no ladder of two levels could be run, or the quantity has no value, or that of 0.
    """
    builder = _Builder(study, mesh, [point for point in asked if not point.failure], implicit=not explicit)
    return builder.build(name, least, within)


class _Builder:
    """The ladders while they grow.

    ``meshes`` and ``steps`` (of a frame) are their levels from coarse to fine. All meshes are run with the steps of the
    level ``shared``, and all steps with the first mesh.
    """

    def __init__(self, study: Study, mesh: MeshControl, asked: Sequence[Point], *, implicit: bool) -> None:
        self.study = study
        self.mesh = mesh
        self.asked = asked
        self.implicit = implicit
        self.remarks: list[str] = []
        self.meshes: list[Setting] = []
        self.steps = self._first_steps()
        self.shared = 1 if self.implicit else 0

    def build(self, name: str, least: float, within: float | None) -> Reference:
        self._begin()
        if any(obstacle.stiffness is None for obstacle in self.study.scene.obstacles):
            self.remarks.append(DEFAULT_STIFFNESS)
        while True:
            reference, cross = self._reference()
            parts = reference.parts.get(name)
            if parts is None:
                runs = [point.first for point in self.study.solve(self._settings())]
                why = next((run.missing[name] for run in runs if name in run.missing), "")
                raise SimulationError(f"the reference has no value of '{name}'" + (f": {why}" if why else ""))
            if not reference.scales[name] > 0.0:
                raise SimulationError(f"the reference has 0 for '{name}': no error is relative to that")
            best = min((reference.errors(p.first).get(name, math.inf) for p in self.asked), default=math.inf)
            need = max(best, least) / MARGIN if within is None else within
            growths = {"space": self._grow_mesh}
            if self.implicit:
                growths["time"] = (
                    self._share_finer_steps if cross[name] > 0.5 * parts["time"].band else self._grow_steps
                )
            order = sorted(growths, key=lambda kind: -parts[kind].band)
            wanted = [kind for kind in order if parts[kind].band > need / MARGIN]
            if reference.band(name) <= need or not any(growths[kind]() for kind in wanted):
                return replace(reference, remarks=list(dict.fromkeys(self.remarks)))

    # ---- ladders

    def _begin(self) -> None:
        """The first levels: three, or two meshes if a third is not to be had."""
        if not self.asked:
            raise SimulationError("there is no reference: every setting failed")
        start = max(self.asked, key=lambda point: point.first.mesh_size).setting.only(self.mesh.names)
        for element in ("quadratic", "linear"):
            first = start.changed(**{f"{FORCED}element": element})
            second = self.mesh.finer(first, 2.0)
            self.meshes = [first] if second is None else [first, second]
            failure = self._failure(self._settings())
            if not failure:
                break
            self.remarks.append(f"{element} cells failed as a reference: {failure}")
        else:
            raise SimulationError(f"there is no reference: {failure}")
        self._grow_mesh()
        if len(self.meshes) < 2:
            raise SimulationError("there is no reference: " + "; ".join(self.remarks))

    def _first_steps(self) -> list[int]:
        """Steps of a frame of the first ladder in time; 0 for explicit schemes, whose steps are those of the mesh.

        They are as short as those of the implicit settings: explicit ones are shorter than their errors in time want.
        """
        if not self.implicit:
            return [0]
        interval = 1.0 / self.study.scene.fps
        implicit = [point.first for point in self.asked if point.first.newton_iterations > 0]
        shortest = min((outcome.longest_dt for outcome in implicit), default=interval)
        most = max(4, 2 ** math.ceil(math.log2(max(1.0, interval / shortest) - 1e-6)))
        return [most // 4, most // 2, most]

    def _timed(self, mesh: Setting, steps: int) -> Setting:
        """A mesh with that many steps of a frame."""
        if not self.implicit:
            return mesh.changed(**{"dtype": "float64", f"{FORCED}solver": "velocity_verlet", f"{FORCED}dt": "auto"})
        dt = f"1/{self.study.scene.fps * steps:.12g}"
        return mesh.changed(**{**FINE_ALGEBRA, f"{FORCED}solver": "sdirk3", f"{FORCED}dt": dt})

    def _space(self) -> list[Setting]:
        return [self._timed(mesh, self.steps[self.shared]) for mesh in self.meshes]

    def _time(self) -> list[Setting]:
        return [self._timed(self.meshes[0], steps) for steps in self.steps] if self.implicit else []

    def _crossed(self) -> list[Setting]:
        """The second mesh with the finest steps, which tells how the error in time depends on the mesh."""
        return [self._timed(self.meshes[1], self.steps[-1])] if self.implicit and len(self.meshes) > 1 else []

    def _rough(self) -> list[Setting]:
        """The first mesh with a hundred times the tolerance, which changes more than the tolerance does."""
        return [self._space()[0].changed(**{f"{FORCED}tolerance": COARSE_TOLERANCE})] if self.implicit else []

    def _settings(self) -> list[Setting]:
        return [*self._time(), *self._space(), *self._crossed(), *self._rough()]

    def _failure(self, settings: list[Setting]) -> str:
        """Why some of them failed; empty if none has."""
        return next((point.failure for point in self.study.solve(settings) if point.failure), "")

    def _grow_mesh(self) -> bool:
        """Adds a finer mesh; false if that is not to be had."""
        if len(self.meshes) == MOST_LEVELS:
            self.remarks.append(f"{MOST_LEVELS} meshes are not enough")
            return False
        last = self.study.solve(self._space()[-1:])[0].first
        why = "its meshes do not get finer"
        for finer, factor in self._next_meshes():
            if not self._affordable(factor ** (self.study.scene.dim + 1) * last.seconds[0]):
                why = f"a reference with a finer mesh would take more than {self.study.limit:g} s"
                continue
            (point,) = self.study.solve([self._timed(finer, self.steps[self.shared])])
            if point.failure:
                self.remarks.append(f"a finer mesh failed as a reference: {point.failure}")
                return False
            if point.first.mesh_size < LEAST_CHANGE * last.mesh_size:
                self.meshes.append(finer)
                return True
        self.remarks.append(why)
        return False

    def _next_meshes(self) -> list[tuple[Setting, float]]:
        """What may follow the last mesh, and by how much it is finer.

        The first three are finer by 2 each, the others by 1.5 and 4/3 in turn, so that each is finer by 2 than the last
        but one: of many kinds of meshes those of even numbers of cells have more in common than with odd ones.
        """
        last, before = self.meshes[-1], self.meshes[-2:-1]
        doubled, between = self.mesh.finer(last, 2.0), self.mesh.finer(last, 1.5)
        found = [(between, 2.0 if between == doubled else 1.5)]
        if len(self.meshes) < 3:
            found.insert(0, (doubled, 2.0))
        elif (own := self.mesh.finer(before[0], 2.0)) != last:
            sizes = [point.first.mesh_size for point in self.study.solve(self._space()[-2:])]
            found.insert(0, (own, 2.0 * sizes[1] / sizes[0]))
        return [(finer, factor) for finer, factor in found if finer is not None and finer not in self.meshes]

    def _grow_steps(self) -> bool:
        """Adds shorter steps; false if that is not to be had."""
        if len(self.steps) == MOST_LEVELS:
            self.remarks.append(f"{MOST_LEVELS} lengths of steps are not enough")
            return False
        slowest = max(point.first.seconds[0] for point in self.study.solve([self._time()[-1], *self._crossed()]))
        if not self._affordable(2.0 * slowest):
            self.remarks.append(f"a reference with shorter steps would take more than {self.study.limit:g} s")
            return False
        self.steps.append(2 * self.steps[-1])
        failure = self._failure([*self._time(), *self._crossed()])
        if failure:
            self.steps.pop()
            self.remarks.append(f"shorter steps failed as a reference: {failure}")
        return not failure

    def _share_finer_steps(self) -> bool:
        """Runs all meshes with shorter steps; false if that is not to be had."""
        if self.shared + 2 > len(self.steps) - 1 and not self._grow_steps():
            return False
        slowest = self.study.solve(self._space()[-1:])[0].first.seconds[0]
        ratio = self.steps[self.shared + 1] / self.steps[self.shared]
        if not self._affordable(ratio * slowest):
            self.remarks.append(f"all meshes with shorter steps would take more than {self.study.limit:g} s")
            return False
        self.shared += 1
        failure = self._failure(self._settings())
        if failure:
            self.shared -= 1
            self.remarks.append(f"shorter steps failed as a reference: {failure}")
        return not failure

    def _affordable(self, seconds: float) -> bool:
        return seconds <= self.study.limit

    # ---- the sum

    def _reference(self) -> tuple[Reference, dict[str, float]]:
        """The reference that the ladders give, and the part of each band in time that depends on the mesh."""
        space, time = (
            [_rung(point) for point in self.study.solve(settings)] for settings in (self._space(), self._time())
        )
        crossed, rough = (
            [point.first for point in self.study.solve(settings)] for settings in (self._crossed(), self._rough())
        )
        levels = space, time, crossed, rough
        sums = {LARGEST: LadderSum(*levels, lambda outcome: outcome.motion)}
        reached = [*(rung.outcome for rung in (*space, *time)), *crossed, *rough]
        for name in space[0].outcome.quantities:
            if all(name in outcome.quantities for outcome in reached):
                sums[name] = LadderSum(*levels, functools.partial(_number, name))
        motion = sums[LARGEST].value
        scales = {L2: _peak_rms(motion), LARGEST: float(np.linalg.norm(motion, axis=-1).max())}
        if scales[LARGEST] == 0.0:
            raise SimulationError("nothing moves in this scene: there is no error to measure")
        parts = {L2: sums[LARGEST].parts(scales[L2], 0), LARGEST: sums[LARGEST].parts(scales[LARGEST], 1)}
        cross = {L2: sums[LARGEST].cross[0] / scales[L2], LARGEST: sums[LARGEST].cross[1] / scales[LARGEST]}
        values = {name: float(own.value[0]) for name, own in sums.items() if name != LARGEST}
        for name, value in values.items():
            scales[name] = abs(value) or math.nan
            # a number can stand still by accident: it is claimed to be no more accurate than the motion that it is of
            parts[name] = {
                kind: replace(part, band=max(part.band, parts[L2][kind].band))
                for kind, part in sums[name].parts(scales[name], 0).items()
            }
            cross[name] = max(sums[name].cross[0] / scales[name], cross[L2])
        limits = {
            kind: Outcome(
                times=space[0].outcome.times,
                motion=sums[LARGEST].limits[kind].value,
                quantities={name: float(sums[name].limits[kind].value[0]) for name in values},
            )
            for kind in sums[LARGEST].limits
        }
        outcome = Outcome(times=space[0].outcome.times, motion=motion, quantities=values)
        return Reference(outcome, scales, parts, {"space": space, "time": time}, limits), cross


def _rung(point: Point) -> Rung:
    return Rung(point.setting, point.first.mesh_size, point.first)


def _peak_rms(motion: np.ndarray) -> float:
    return float(np.sqrt((motion**2).sum(axis=-1).mean(axis=-1)).max())


def _number(name: str, outcome: Outcome) -> np.ndarray:
    return np.array([outcome.quantities[name]])
