"""Measures warpfem beside other codes and writes docs/performance.md.

    python benchmarks/performance [--quick] [--case NAME ...] [--out docs/performance.md]

Results go to a JSON file beside the plots as each case ends; the page is written from all that are there, so cases can
run one at a time. ``--install`` makes environments for the peers first; without, those that are missing are shown as
such. Run it on an idle machine.
"""

import argparse
import importlib
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from performance import machine, peers

CASES = ("explicit", "implicit", "trajectory", "static", "scaling", "start")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", nargs="+", choices=CASES, default=CASES, help="what to measure (all)")
    parser.add_argument("--quick", action="store_true", help="small sizes and few repeats, to try the harness")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2], help="numbers of threads (1 2)")
    parser.add_argument("--peers", type=Path, default=Path(".peers"), help="environments of the peers (.peers)")
    parser.add_argument("--install", action="store_true", help="make environments for peers that are missing")
    parser.add_argument("--out", type=Path, default=Path("docs/performance.md"), help="the page")
    options = parser.parse_args()
    folder = options.peers.resolve()
    if options.install:
        peers.install(folder)
    path = options.out.with_suffix("") / "results.json"
    path.parent.mkdir(parents=True, exist_ok=True)

    def known() -> dict[str, Any]:
        return json.loads(path.read_text()) if path.exists() else {}

    for name in options.case:
        print(name)
        case = importlib.import_module(f"performance.{name}")
        found = {
            "machine": machine.facts(),
            "versions": {peer: peers.version(peer, folder) for peer in ("warpfem", "warp", *peers.PEERS)},
            "quick": options.quick,
            **case.run(options.quick, folder, tuple(options.threads)),
        }
        results = {**known(), name: found}  # others may have come by since
        path.write_text(json.dumps(results, indent=1) + "\n")
    from performance.report import write  # needs matplotlib, which measuring does not

    write(known(), options.out)


if __name__ == "__main__":
    main()
