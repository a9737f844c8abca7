"""Runs contenders in turn: each is a process that waits while the others run."""

import contextlib
import json
import os
import statistics
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from performance.peers import interpreter

CONTENDERS = Path(__file__).with_name("contenders")


@dataclass(frozen=True)
class Contender:
    """One who takes part in a case.

    Attributes:
        name: as the page has it.
        script: its file in ``contenders``.
        peer: the module that its interpreter must have.
        options: what the script is told.
    """

    name: str
    script: str
    peer: str = "warpfem"
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def threads(self) -> int:
        return int(self.options.get("threads", 1))


@dataclass
class Outcome:
    """What a contender did.

    Attributes:
        contender: who.
        missing: why there is no result; empty if there is one.
        ready: what it told of its set-up.
        turns: what it told of each turn, ``seconds`` first of all.
        arrays: what contenders are compared by.
    """

    contender: Contender
    missing: str = ""
    ready: dict[str, Any] = field(default_factory=dict)
    turns: list[dict[str, Any]] = field(default_factory=list)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def seconds(self) -> list[float]:
        return [turn["seconds"] for turn in self.turns]

    @property
    def median(self) -> float:
        return statistics.median(self.seconds)

    @property
    def best(self) -> float:
        return min(self.seconds)

    @property
    def spread(self) -> float:
        """Half the distance between the quartiles, relative to the median."""
        low, high = np.percentile(self.seconds, [25, 75])
        return float(high - low) / 2 / self.median

    def summary(self) -> dict[str, Any]:
        """For the file of results."""
        known = {} if self.missing else {"median": self.median, "best": self.best, "spread": self.spread}
        return {
            "name": self.contender.name,
            "threads": self.contender.threads,
            "missing": self.missing,
            "ready": self.ready,
            "turns": self.turns,
            **known,
        }


def ratio(one: Outcome, other: Outcome) -> float:
    """How many times longer ``one`` takes: the median over turns, since the clock rate changes between them."""
    return statistics.median(a / b for a, b in zip(one.seconds, other.seconds, strict=True))


class _Process:
    def __init__(self, contender: Contender, problem: Path, peers: Path) -> None:
        python = interpreter(contender.peer, peers)
        if python is None:
            raise RuntimeError("not installed")
        threads = str(contender.threads)
        environment = {
            **os.environ,
            **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), threads),
            "OMP_WAIT_POLICY": "passive",  # who has had a turn must not spin in the next one's
            "PYTHONPATH": os.pathsep.join([str(CONTENDERS), str(CONTENDERS.parents[2])]),
        }
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        self._process = subprocess.Popen(
            [python, CONTENDERS / contender.script, problem, json.dumps(contender.options)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=environment,
        )

    def answer(self) -> dict[str, Any]:
        line = self._process.stdout.readline()
        while line and not line.startswith("{"):  # libraries print as they are imported
            line = self._process.stdout.readline()
        if not line:
            self._process.wait()
            self._errors.seek(0)
            told = self._errors.read().decode(errors="replace").strip().splitlines()
            raise RuntimeError(told[-1] if told else f"ended with status {self._process.returncode}")
        return json.loads(line)

    def ask(self, command: str) -> dict[str, Any]:
        with contextlib.suppress(BrokenPipeError):  # then there is no answer, and the reason is told
            self._process.stdin.write(command + "\n")
            self._process.stdin.flush()
        return self.answer()

    def close(self) -> None:
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(timeout=30.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self._errors.close()


def take_turns(
    contenders: list[Contender], problem: dict[str, Any], repeats: int, peers: Path, budget: float = 60.0
) -> list[Outcome]:
    """Sets all contenders up, one after the other, then lets them run in turn.

    Args:
        contenders: who takes part.
        problem: arrays that each is given.
        repeats: how often each has its turn.
        peers: the folder of the peers' environments.
        budget: seconds of turns after which no further round begins, once there were three.
    """
    outcomes = [Outcome(contender) for contender in contenders]
    processes: dict[int, _Process] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "problem.npz")
        np.savez(path, **problem)
        for i, contender in enumerate(contenders):
            try:
                process = _Process(contender, path, peers)
                processes[i] = process
                outcomes[i].ready = process.answer()
            except RuntimeError as error:
                outcomes[i].missing = str(error)
                if i in processes:
                    processes.pop(i).close()
        _go_round(processes, outcomes, repeats, budget)
        for i, process in processes.items():
            arrays = Path(folder, f"{i}.npz")
            process.ask(f"save {arrays}")
            outcomes[i].arrays = dict(np.load(arrays))
            process.close()
    for outcome in outcomes:
        print(f"    {outcome.contender.name}: {outcome.missing or f'{outcome.median:.3g} s'}")
    return outcomes


def _go_round(processes: dict[int, _Process], outcomes: list[Outcome], repeats: int, budget: float) -> None:
    start = time.monotonic()
    for repeat in range(repeats):
        if repeat >= 3 and time.monotonic() - start > budget:
            break
        for i in list(processes):
            try:
                outcomes[i].turns.append(processes[i].ask("turn"))
            except RuntimeError as error:
                outcomes[i].missing = str(error)
                processes.pop(i).close()
