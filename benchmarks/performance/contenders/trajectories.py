"""What contenders share that follow a motion: every setting is run in each turn, and its error told."""

import time

import numpy as np
from serving import Contender


def follow(settings, prepare, problem):
    """A contender that runs all settings.

    Args:
        settings: by name, what ``prepare`` takes.
        prepare: returns two functions for a setting: one that starts anew, and one that advances by a time [s] and
            returns the displacements.
        problem: has the ``reference`` displacements at times that are ``interval`` apart.
    """
    reference, interval = problem["reference"], float(problem["interval"])
    peak = np.linalg.norm(reference, axis=2).max()
    prepared = {name: prepare(setting) for name, setting in settings.items()}

    def run():
        results = {}
        for name, (reset, advance) in prepared.items():
            reset()
            seconds = error = 0.0
            for expected in reference:
                start = time.perf_counter()
                found = advance(interval)
                seconds += time.perf_counter() - start
                error = np.maximum(
                    error, np.linalg.norm(found - expected, axis=1).max() / peak
                )  # keeps what is not a number
                if not error < 10.0:
                    error = 1e9  # JSON has no infinity
                    break
            results[name] = {"seconds": seconds, "error": float(error)}
        return {"seconds": sum(r["seconds"] for r in results.values()), "settings": results}

    return Contender(run)
