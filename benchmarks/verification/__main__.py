"""Runs the verification suite and writes its page.

Run: python benchmarks/verification [--quick] [--case NAME ...] [--out docs/accuracy.md]

Cases run in as many processes as there are processors. Exits with 1 if a check fails. ``--quick`` takes coarse meshes
and few settings, as the tests do.
"""

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path

if not __package__:  # run as a folder
    sys.path[0] = str(Path(__file__).resolve().parent.parent)

from verification import report
from verification.cases import CASES, run_named


def main() -> int:
    parser = argparse.ArgumentParser(prog="python benchmarks/verification", description="Runs the verification suite.")
    parser.add_argument("--quick", action="store_true", help="coarse meshes and few settings")
    parser.add_argument("--case", nargs="+", choices=sorted(CASES), default=list(CASES), help="cases to run")
    parser.add_argument("--out", type=Path, help="where to write the page (Markdown)")
    options = parser.parse_args()
    outcomes = []
    with ProcessPoolExecutor(min(len(options.case), os.cpu_count() or 1), get_context("spawn")) as pool:
        for outcome in pool.map(run_named, options.case, repeat(options.quick)):
            outcomes.append(outcome)
            print(report.text(outcome), flush=True)
    if options.out:
        options.out.write_text(report.markdown(outcomes, options.quick), encoding="utf-8")
    return int(any(outcome.failures for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
