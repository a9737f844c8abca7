"""How a command starts Warp, is interrupted, and ends."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

OK, FAILED, WRONG_USE = 0, 1, 2
"""Exit codes."""


def fail(error: Exception, code: int) -> int:
    """Prints an error with its notes; returns the code."""
    print(f"warpfem: {error}", file=sys.stderr)
    for note in getattr(error, "__notes__", ()):
        print(f"  {note}", file=sys.stderr)
    return code


def start_warp() -> None:
    """Starts Warp without its reports of loaded modules, and without its warning that there is no CUDA driver."""
    import warp

    warp.config.log_level = warp.LOG_ERROR
    sys.stderr.flush()
    kept = os.dup(2)  # the warning comes from native code
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            warp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)


@contextmanager
def held_interrupt() -> Iterator[Callable[[], None]]:
    """Holds back the first Ctrl-C or SIGTERM until the function that it gives is called; a second one stops at once.

    Raised just anywhere, the interrupt would be lost in the import of the USD libraries or in a destructor.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    seen = []

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(*_: object) -> None:
        seen.append(True)
        restore()

    def check() -> None:
        if seen:
            raise KeyboardInterrupt

    for number in before:
        signal.signal(number, note)
    try:
        yield check
    finally:
        restore()
