"""Runs settings of a problem, each as often as asked for and not more than is missing."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from warpfem.child import noting_files
from warpfem.errors import OutputError, described
from warpfem.places import spread_places
from warpfem.trade.machine import facts
from warpfem.trade.outcome import Load, Order, Outcome
from warpfem.trade.problem import Problem, Setting
from warpfem.trade.process import run_order
from warpfem.trade.store import Store

PLACES = 400
"""Places at which motions are compared, over all bodies, each standing for the same volume."""

FEWEST_PLACES = 10
"""Places of a body that is a small part of the volume."""

ROUNDS = 5
"""Runs in one process of a setting whose runs are short."""

SUBMISSIONS = 3
"""How often an order is submitted whose worker is lost."""

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Point:
    """A setting and what its runs gave.

    Attributes:
        setting: the setting.
        outcomes: of its runs; those of one setting fail together, but for their times.
    """

    setting: Setting
    outcomes: tuple[Outcome, ...]

    @property
    def first(self) -> Outcome:
        """The outcome that stands for the motion: the first without failure, if there is one."""
        return next((outcome for outcome in self.outcomes if not outcome.failure), self.outcomes[-1])

    @property
    def failure(self) -> str:
        """Why the setting has no result; empty if it has."""
        return self.first.failure

    @cached_property
    def samples(self) -> list[float]:
        """Wall time of the steps [s], the median of each process."""
        return [statistics.median(outcome.seconds) for outcome in self.outcomes if not outcome.failure]

    @property
    def seconds(self) -> float:
        """Wall time of the steps, the median of the processes [s]."""
        return statistics.median(self.samples)

    @property
    def spread(self) -> tuple[float, float]:
        """The least and the greatest time of a process [s]."""
        return min(self.samples), max(self.samples)

    @property
    def kernel_seconds(self) -> tuple[float, float]:
        """The least and the greatest time that a process took to compile or load kernels [s]."""
        times = [outcome.kernel_seconds for outcome in self.outcomes if not outcome.failure]
        return min(times), max(times)

    @property
    def peak_bytes(self) -> int:
        """The largest memory of a process."""
        return max(outcome.peak_bytes for outcome in self.outcomes)


class Study:
    """Runs settings of a problem and keeps what comes of them.

    Args:
        problem: the problem.
        store: where outcomes are kept, and those that are there already.
        executor: what runs orders.
        load: whether it runs several at the same time on one machine.
        limit: wall time of a process [s].
        threads: threads that explicit steps may use in each; ``None`` for all cores.
        say: is told what has been done.

    Raises:
        WarpfemError: the scene as written cannot be built.
    """

    def __init__(
        self,
        problem: Problem,
        store: Store,
        executor: Executor,
        *,
        load: Load = "serial",
        limit: float = 600.0,
        threads: int | None = None,
        say: Say = lambda text: None,
    ) -> None:
        self.store = store
        self.load = load
        self.limit = limit
        self.threads = threads
        self.say = say
        self._executor = executor
        self._machine = facts()
        self._given_up: set[Setting] = set()
        with noting_files() as files:
            self.scene = problem.build(Setting()).scene
        self.problem = problem.reading(files)
        self.places = store.places(self.problem, self._spread)

    def _spread(self) -> list[np.ndarray]:
        volumes = np.array([body.mesh.cell_volumes.sum() for body in self.scene.bodies])
        counts = np.maximum(FEWEST_PLACES, np.rint(PLACES * volumes / volumes.sum()).astype(int))
        return [spread_places(body.mesh, count) for body, count in zip(self.scene.bodies, counts, strict=True)]

    def shortened(self, frames: int) -> Study:
        """The same study of the first frames alone."""
        if frames == self.scene.frames:
            return self  # its outcomes are those of all frames
        return self._like(replace(self.problem, frames=frames), self.load, self.threads)

    def alone(self) -> Study:
        """The same study, one run after the other if each is asked for alone."""
        return self._like(self.problem, "serial", None)

    def _like(self, problem: Problem, load: Load, threads: int | None) -> Study:
        return Study(problem, self.store, self._executor, load=load, limit=self.limit, threads=threads, say=self.say)

    def run(self, settings: Sequence[Setting], repeats: int = 1) -> list[Point]:
        """Runs settings, round after round, so that slow changes of the machine's speed show in the spread.

        Outcomes that the store has, of the same load and machine, are not run again.

        Args:
            settings: the settings.
            repeats: processes for each.

        Returns:
            Their points, in the same order.

        Raises:
            OutputError: an outcome cannot be stored, or the cluster is lost.
        """
        for round in range(repeats):
            self._run_missing(settings, round + 1, ROUNDS)
        return [Point(setting, tuple(self._own(setting))) for setting in settings]

    def solve(self, settings: Sequence[Setting]) -> list[Point]:
        """As :meth:`run`, once, for the motion alone: an outcome of any load and machine will do."""
        known = {s: [o for o in self.store.outcomes(self.problem, s) if not o.failure] for s in settings}
        self._run_missing([setting for setting, outcomes in known.items() if not outcomes], 1, 1)
        return [Point(s, tuple(known[s] or self._own(s))) for s in settings]

    def _run_missing(self, settings: Sequence[Setting], count: int, rounds: int) -> None:
        """Runs the settings that have fewer than ``count`` outcomes, once."""
        missing = [setting for setting in dict.fromkeys(settings) if self._lacks(setting, count)]
        for setting, outcome in self._run_each(missing, rounds):
            self.store.add(self.problem, setting, outcome)
            if outcome.by_chance:
                self._given_up.add(setting)  # until the study is taken up again
            told = outcome.failure or f"{statistics.median(outcome.seconds):.3g} s of steps"
            self.say(f"{setting.label}: {told}")

    def _own(self, setting: Setting) -> list[Outcome]:
        """The outcomes that count for a setting: those of the study's load, and of this machine if it is serial."""
        own = [o for o in self.store.outcomes(self.problem, setting) if o.load == self.load]
        return own if self.load == "parallel" else [o for o in own if self._is_of_this_machine(o)]

    def _is_of_this_machine(self, outcome: Outcome) -> bool:
        return all(outcome.machine.get(name) == self._machine[name] for name in ("processor", "cores"))

    def _lacks(self, setting: Setting, count: int) -> bool:
        own = self._own(setting)
        good = sum(not outcome.failure for outcome in own)
        for_good = [o for o in own if o.failure and not o.by_chance and not 0.0 < o.limit < self.limit]
        return good < count and not for_good and setting not in self._given_up

    def _run_each(self, settings: Sequence[Setting], rounds: int) -> Iterator[tuple[Setting, Outcome]]:
        """Outcomes as they come; what a lost worker had in hand is submitted again."""
        orders = {
            setting: Order(self.problem, setting, self.places, rounds, self.limit, self.load, self.threads)
            for setting in settings
        }
        futures: dict[Future[Outcome], tuple[Setting, int]] = {
            self._submit(order): (setting, 1) for setting, order in orders.items()
        }
        while futures:
            done, _ = wait(futures, return_when=FIRST_COMPLETED)
            for future in done:
                setting, submitted = futures.pop(future)
                try:
                    outcome = future.result()
                except (Exception, CancelledError) as error:
                    if submitted == SUBMISSIONS:
                        raise OutputError(
                            f"{setting.label}: {submitted} workers were lost, the last with {described(error)}: what "
                            "came before is kept, and the same command goes on"
                        ) from None
                    self.say(f"{setting.label}: a worker was lost ({described(error)}), submitted again")
                    futures[self._submit(orders[setting])] = setting, submitted + 1
                    continue
                yield setting, outcome

    def _submit(self, order: Order) -> Future[Outcome]:
        """What comes of an order; an executor that takes none, as when its cluster is gone, has lost it."""
        try:
            return self._executor.submit(run_order, order)
        except Exception as error:
            lost: Future[Outcome] = Future()
            lost.set_exception(error)
            return lost


@dataclass(frozen=True)
class Difference:
    """How far two motions are apart.

    Attributes:
        l2: root mean square over frames and places of the distance [m].
        largest: the largest distance [m].
        quantities: the differences of the quantities that both have, by name.
    """

    l2: float
    largest: float
    quantities: dict[str, float]


def difference(one: Outcome, other: Outcome) -> Difference:
    """The difference of two outcomes of the same problem.

    Raises:
        OutputError: their frames are at other times.
    """
    if one.motion.shape != other.motion.shape or not np.allclose(one.times, other.times, rtol=1e-9, atol=0.0):
        raise OutputError("the frames are at other times than those of the reference: fps and frames are no axes")
    distance = np.linalg.norm(one.motion - other.motion, axis=-1)
    shared = [name for name in one.quantities if name in other.quantities]
    return Difference(
        float(np.sqrt((distance**2).mean())),
        float(distance.max()),
        {name: one.quantities[name] - other.quantities[name] for name in shared},
    )
