"""What ``warpfem trade`` and ``warpfem tune`` share: the study that runs settings and keeps what comes of them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from warpfem.trade.problem import Problem
    from warpfem.trade.study import Study


@contextmanager
def opened_study(
    arguments: argparse.Namespace, problem: Problem, folder: Path, say: Callable[[str], None]
) -> Iterator[Study]:
    """What runs settings of a problem, and keeps what comes of them in a folder."""
    from warpfem.trade.executors import cluster_executor, local_executor
    from warpfem.trade.store import Store
    from warpfem.trade.study import Study

    alone = arguments.workers == 1 and arguments.scheduler is None
    executor = cluster_executor(arguments.scheduler) if arguments.scheduler else local_executor(arguments.workers)
    with executor as pool:
        yield Study(
            problem,
            Store(folder),
            pool,
            load="serial" if alone else "parallel",
            limit=float(arguments.limit),
            threads=None if alone else 1,
            say=say,
        )
