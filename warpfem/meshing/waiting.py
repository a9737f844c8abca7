"""A line on the terminal while something takes long."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

PATIENCE = 1.0
"""Seconds until the line appears, and between its changes."""


@contextmanager
def telling_time(what: str, wanted: bool = True) -> Iterator[None]:
    """Says on the standard error, if that is a terminal, what is done and since how many seconds; then erases it."""
    if not (wanted and sys.stderr.isatty()):
        yield
        return
    done = threading.Event()
    teller = threading.Thread(target=_tell, args=(what, done), daemon=True)
    teller.start()
    try:
        yield
    finally:
        done.set()
        teller.join()


def _tell(what: str, done: threading.Event) -> None:
    start, said = time.monotonic(), 0
    while not done.wait(PATIENCE):
        said = sys.stderr.write(f"\r{what}: {time.monotonic() - start:.0f} s") - 1
        sys.stderr.flush()
    if said:
        sys.stderr.write(f"\r{' ' * said}\r")
        sys.stderr.flush()
