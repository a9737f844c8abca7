"""How a contender talks to the harness: it gets ready once, then runs whenever it is its turn.

    python CONTENDER.py PROBLEM.npz OPTIONS_AS_JSON

Lines on standard output are JSON: first what getting ready took, then the answer to each line of standard input,
"turn" (run once) or "save PATH" (write what is compared between contenders). Contenders run under interpreters of
their own, so this file needs no more than NumPy.
"""

import json
import os
import resource
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass
class Contender:
    """What a contender has set up.

    Attributes:
        run: runs once and returns at least its ``seconds``.
        outcome: the arrays that contenders are compared by, after a run.
        facts: anything to be told.
    """

    run: Callable[[], dict[str, Any]]
    outcome: Callable[[], Mapping[str, np.ndarray]] = dict
    facts: dict[str, Any] = field(default_factory=dict)


def timed(action: Callable[[], object]) -> float:
    """The wall time of an action [s]."""
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def settled(run: Callable[[], dict[str, Any]]) -> Callable[[], dict[str, Any]]:
    """A turn of two runs, of which the second counts, as in a simulation of many: the first finds others' data in the
    caches, and threads asleep."""

    def twice() -> dict[str, Any]:
        run()
        return run()

    return twice


def memory_bytes() -> int:
    """The most memory that the process has held [bytes]."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def serve(setup: Callable[[dict[str, np.ndarray], dict[str, Any]], Contender]) -> None:
    """Answers the harness until it closes standard input."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what libraries print goes to standard error

    def answer(content: dict[str, Any]) -> None:
        answers.write(json.dumps(content) + "\n")

    start = time.perf_counter()
    problem = dict(np.load(sys.argv[1]))
    before = memory_bytes()
    contender = setup(problem, json.loads(sys.argv[2]))
    ready = time.perf_counter()
    first = contender.run()  # compiles what is compiled late
    answer(
        {
            "setup_seconds": ready - start,
            "first_seconds": time.perf_counter() - ready,
            "memory_bytes": memory_bytes() - before,
            "first": first,
            **contender.facts,
        }
    )
    for line in sys.stdin:
        command, _, path = line.strip().partition(" ")
        if command == "turn":
            answer({**contender.run(), "memory_bytes": memory_bytes() - before})
        else:
            np.savez(path, **contender.outcome())
            answer({})
