"""The process that runs one setting: ``python -m warpfem.trade.worker``, with the order on its standard input."""

from __future__ import annotations

import os
import pickle
import struct
import sys
import threading

LENGTH = struct.Struct("<Q")
"""Comes before the order: its length."""


def main() -> None:
    """Reads the order, runs it, and writes the outcome to the standard output."""
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # scenes and libraries print what they like
    source = sys.stdin.buffer
    (length,) = LENGTH.unpack(source.read(LENGTH.size))
    order = pickle.loads(source.read(length))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    from warpfem.trade.measure import measure

    pickle.dump(measure(order), answer, protocol=5)
    answer.close()
    os._exit(0)  # destructors have nothing to save, and take time


def _end_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(1)


if __name__ == "__main__":
    main()
