"""Runs the verification suite and writes its page.

Run: python benchmarks/verification [--quick] [--case NAME ...] [--out docs/accuracy.md]

Exits with 1 if a check fails. ``--quick`` takes coarse meshes and few settings, as the tests do.
"""

import argparse
import sys
from pathlib import Path

if not __package__:  # run as a folder
    sys.path[0] = str(Path(__file__).resolve().parent.parent)

import warp as wp

from verification import report
from verification.cases import CASES
from verification.core import run_case


def main() -> int:
    parser = argparse.ArgumentParser(prog="python benchmarks/verification", description="Runs the verification suite.")
    parser.add_argument("--quick", action="store_true", help="coarse meshes and few settings")
    parser.add_argument("--case", nargs="+", choices=sorted(CASES), default=list(CASES), help="cases to run")
    parser.add_argument("--out", type=Path, help="where to write the page (Markdown)")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    outcomes = []
    for name in options.case:
        outcomes.append(run_case(CASES[name], options.quick))
        print(report.text(outcomes[-1]), flush=True)
    if options.out:
        options.out.write_text(report.markdown(outcomes, options.quick), encoding="utf-8")
    return int(any(outcome.failures for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
