"""The reference of a study: finer in space and time than what is asked about, extrapolated, with an error band.

Two ladders of runs, in float64 and with a tight tolerance, of quadratic cells and a scheme of third order: one of
meshes with a fixed time step, one of time steps with the coarsest of these meshes. Each is extrapolated, and the sum of
the limit in space and of what is missing in time is the reference. A ladder grows by a level until the reference is
four times as accurate as the best setting, or the next run would take too long.

Explicit steps are as long as each mesh allows: their errors fall with those of the mesh, and one ladder does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from warpfem.errors import SimulationError
from warpfem.solvers.implicit import ImplicitSolver
from warpfem.trade.axes import MeshControl
from warpfem.trade.extrapolation import CLAIM, Extrapolated, extrapolate
from warpfem.trade.outcome import Outcome
from warpfem.trade.problem import FORCED, Setting
from warpfem.trade.study import Difference, Point, Study, difference

MARGIN = 4.0
"""How many times as accurate as the best setting the reference shall be."""

FINE_ALGEBRA = {"dtype": "float64", f"{FORCED}tolerance": "1e-8"}
COARSE_TOLERANCE = "1e-6"

L2, LARGEST = "l2", "max"
"""The two norms over the trajectory, among the names of what errors are measured of."""

MOST_LEVELS = 6
"""Levels of a ladder beyond which a finer one is not the answer."""


@dataclass(frozen=True, eq=False)
class Rung:
    """A level of a ladder."""

    setting: Setting
    size: float
    outcome: Outcome


@dataclass(frozen=True)
class Part:
    """What one ladder, or the algebra, leaves open of a quantity.

    Attributes:
        order: observed; ``None`` if there is none.
        band: relative to the scale of the quantity.
        remark: why there is no order.
    """

    order: float | None
    band: float
    remark: str = ""


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


def build_reference(study: Study, mesh: MeshControl, asked: Sequence[Point], name: str = L2) -> Reference:
    """The reference of settings that have been run.

    Args:
        study: runs what the ladders need.
        mesh: makes meshes finer.
        asked: the settings that it has to be more accurate than.
        name: of what: a norm, or a quantity of the scene.

    Raises:
        SimulationError: no ladder of two levels could be run.
    """
    return _Builder(study, mesh, [point for point in asked if not point.failure]).build(name)


class _Builder:
    def __init__(self, study: Study, mesh: MeshControl, asked: Sequence[Point]) -> None:
        self.study = study
        self.mesh = mesh
        self.asked = asked
        self.implicit = isinstance(study.scene.solver, ImplicitSolver)
        self.remarks: list[str] = []
        self.space: list[Rung] = []
        self.time: list[Rung] = []
        self.algebra: Outcome | None = None  # with a hundred times the tolerance, which changes more than it does

    def build(self, name: str) -> Reference:
        self._begin()
        while True:
            reference = self._reference()
            best = min((reference.errors(p.first).get(name, math.inf) for p in self.asked), default=math.inf)
            need = best / MARGIN
            parts = reference.parts.get(name)
            if parts is None:
                known = ", ".join(reference.names)
                raise SimulationError(f"the reference has no value of '{name}': it has {known}")
            if reference.band(name) <= need:
                return reference
            ladders = ["space", "time"] if self.implicit else ["space"]
            ladders.sort(key=lambda kind: -parts[kind].band)
            if "algebra" in parts and parts["algebra"].band > max(parts[kind].band for kind in ladders):
                self.remarks.append("rounding or the tolerance of the solver limits the reference")
                return self._reference()
            for kind in ladders:
                if parts[kind].band > 0.25 * need and self._grow(kind):
                    break
            else:
                return self._reference()

    # ---- ladders

    def _begin(self) -> None:
        if not self.asked:
            raise SimulationError("there is no reference: every setting failed")
        start = max(self.asked, key=lambda point: point.first.mesh_size).setting.only(self.mesh.names)
        for element in ("quadratic", "linear"):
            base = start.changed(**{f"{FORCED}element": element})
            steps = self._first_steps()
            settings = [self._timed(base, count) for count in steps]
            finer = self.mesh.finer(base, 2.0)
            meshes = [self._timed(own, steps[-2]) for own in (finer,) if own is not None]
            rough = self._timed(base, steps[-2]).changed(**{f"{FORCED}tolerance": COARSE_TOLERANCE})
            extra = [rough] if self.implicit else []
            points = self.study.solve(settings + meshes + extra)
            failures = [point.failure for point in points if point.failure]
            if not failures:
                break
            self.remarks.append(f"{element} cells failed as a reference: {failures[0]}")
        else:
            raise SimulationError(f"there is no reference: {failures[0]}")
        rungs = [_rung(point) for point in points]
        self.time = rungs[: len(settings)]
        self.space = [self.time[-2], *rungs[len(settings) : len(settings) + len(meshes)]]
        self.algebra = rungs[-1].outcome if self.implicit else None
        if len(self.space) < 2 or (len(self.space) < 3 and not self._grow("space")):
            self.remarks.append("the meshes for an observed order would take too long")
        if len(self.space) < 2:
            raise SimulationError("there is no reference: " + "; ".join(self.remarks))

    def _first_steps(self) -> list[int]:
        """Steps of a frame of the first ladder in time; 0 for explicit schemes, whose steps are those of the mesh."""
        if not self.implicit:
            return [0, 0]
        interval = 1.0 / self.study.scene.fps
        shortest = min((p.first.shortest_dt for p in self.asked if p.first.shortest_dt > 0.0), default=interval)
        most = max(4, 2 ** math.ceil(math.log2(max(1.0, interval / shortest) - 1e-6)))
        return [most // 4, most // 2, most]

    def _timed(self, base: Setting, steps: int) -> Setting:
        """The setting with that many steps of a frame, accurate in time; 0 for as few as are stable."""
        if not self.implicit:
            fine = {"dtype": "float64", f"{FORCED}solver": "velocity_verlet", f"{FORCED}dt": "auto"}
        else:
            dt = f"1/{self.study.scene.fps * steps:.12g}"
            fine = {**FINE_ALGEBRA, f"{FORCED}solver": "sdirk3", f"{FORCED}dt": dt}
        return base.changed(**fine)

    def _grow(self, kind: str) -> bool:
        """Adds a level to a ladder; false if that is not to be had."""
        ladder = self.space if kind == "space" else self.time
        if len(ladder) >= MOST_LEVELS:
            self.remarks.append(f"{MOST_LEVELS} levels in {kind} are not enough")
            return False
        last = ladder[-1]
        dim = self.study.scene.dim
        for factor in (2.0, 1.5):
            if kind == "space":
                finer = self.mesh.finer(last.setting, factor)
                cost = factor ** (dim + 1)
            else:
                old = float(last.setting[f"{FORCED}dt"].partition("/")[2]) / self.study.scene.fps
                finer = self._timed(last.setting, math.ceil(factor * old))
                cost = factor
            if finer is None:
                continue
            expected = cost * last.outcome.seconds[0]
            if expected > self.study.limit:
                continue
            (point,) = self.study.solve([finer])
            if point.failure:
                self.remarks.append(f"a finer reference in {kind} failed: {point.failure}")
                return False
            if kind == "space" and not point.first.mesh_size < 0.95 * last.size:
                continue
            ladder.append(_rung(point))
            return True
        self.remarks.append(f"a finer reference in {kind} would take more than {self.study.limit:g} s")
        return False

    # ---- the sum

    def _reference(self) -> Reference:
        motion = extrapolate([r.outcome.motion for r in self.space], [r.size for r in self.space])
        bare = self.space[0].outcome  # the coarsest mesh with the time step of all meshes
        field_parts = {"space": motion}
        limits = {"space": Outcome(times=bare.times, motion=motion.value)}
        total = motion.value
        missing: np.ndarray | float = 0.0
        if self.implicit:
            in_time = extrapolate([r.outcome.motion for r in self.time], [r.outcome.longest_dt for r in self.time])
            field_parts["time"] = in_time
            limits["time"] = Outcome(times=bare.times, motion=in_time.value)
            missing = in_time.value - bare.motion
            total = total + missing
        scales = {L2: _peak_rms(total), LARGEST: float(np.linalg.norm(total, axis=-1).max())}
        if scales[LARGEST] == 0.0:
            raise SimulationError("nothing moves in this scene: there is no error to measure")
        parts: dict[str, dict[str, Part]] = {L2: {}, LARGEST: {}}
        for kind, own in field_parts.items():
            cross = (0.0, 0.0) if kind == "space" else _norms(missing)  # measured on the coarsest mesh
            parts[L2][kind] = Part(own.order, (own.band + CLAIM * cross[0]) / scales[L2], own.remark)
            parts[LARGEST][kind] = Part(own.order, (own.largest_band + CLAIM * cross[1]) / scales[LARGEST], own.remark)
        rough = None if self.algebra is None else difference(self.algebra, bare)
        if rough is not None:
            parts[L2]["algebra"] = Part(None, rough.l2 / scales[L2])
            parts[LARGEST]["algebra"] = Part(None, rough.largest / scales[LARGEST])
        quantities = {}
        for name in self._shared_quantities():
            value, scale, own_parts = self._quantity(name, bare, rough, limits)
            quantities[name] = value
            scales[name] = scale
            # a number can stand still by accident: it is claimed to be no more accurate than the motion that it is of
            parts[name] = {
                kind: replace(part, band=max(part.band, parts[L2][kind].band)) for kind, part in own_parts.items()
            }
        outcome = Outcome(times=bare.times, motion=total, quantities=quantities)
        ladders = {"space": self.space, "time": self.time}
        return Reference(outcome, scales, parts, ladders, limits, list(self.remarks))

    def _shared_quantities(self) -> list[str]:
        rungs = [*self.space, *(self.time if self.implicit else ())]
        return [name for name in self.space[0].outcome.quantities if all(name in r.outcome.quantities for r in rungs)]

    def _quantity(
        self, name: str, bare: Outcome, rough: Difference | None, limits: dict[str, Outcome]
    ) -> tuple[float, float, dict[str, Part]]:
        """The reference's value of a quantity, what its errors are relative to, and the bands."""

        def limit(rungs: list[Rung], sizes: list[float]) -> Extrapolated:
            return extrapolate([np.array([r.outcome.quantities[name]]) for r in rungs], sizes)

        space = limit(self.space, [r.size for r in self.space])
        value, bands = float(space.value[0]), {"space": space}
        limits["space"].quantities[name] = value
        cross = 0.0
        if self.implicit:
            bands["time"] = limit(self.time, [r.outcome.longest_dt for r in self.time])
            limits["time"].quantities[name] = float(bands["time"].value[0])
            cross = float(bands["time"].value[0]) - bare.quantities[name]
            value += cross
        scale = abs(value)
        if scale == 0.0:
            scale = math.nan
        parts = {
            kind: Part(own.order, (own.band + (CLAIM * abs(cross) if kind == "time" else 0.0)) / scale, own.remark)
            for kind, own in bands.items()
        }
        if rough is not None:
            parts["algebra"] = Part(None, abs(rough.quantities.get(name, 0.0)) / scale)
        return value, scale, parts


def _rung(point: Point) -> Rung:
    return Rung(point.setting, point.first.mesh_size, point.first)


def _peak_rms(motion: np.ndarray) -> float:
    return float(np.sqrt((motion**2).sum(axis=-1).mean(axis=-1)).max())


def _norms(field: np.ndarray | float) -> tuple[float, float]:
    lengths = np.linalg.norm(field, axis=-1)
    return float(np.sqrt((lengths**2).mean())), float(lengths.max())
