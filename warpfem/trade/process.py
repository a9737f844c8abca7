"""Runs an order in a fresh process: a crash, a hang, or memory that has run out is then a result like others."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading

from warpfem.trade.outcome import Order, Outcome
from warpfem.trade.worker import LENGTH

ATTEMPTS = 2
"""How often an order is run whose process is killed: once may be by chance."""

KILLS = ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP")
"""Signals by which others end a process; by the rest it ends itself."""

_running: set[subprocess.Popen[bytes]] = set()
_ended: set[subprocess.Popen[bytes]] = set()


def run_order(order: Order) -> Outcome:
    """The outcome of an order; what goes wrong is its ``failure``."""
    for attempt in range(ATTEMPTS):
        outcome, killed = _attempt(order)
        if not killed or attempt == ATTEMPTS - 1:
            break
    return outcome


def end_all() -> None:
    """Ends the processes that this one has started for orders."""
    for process in list(_running):
        _ended.add(process)
        process.kill()


def _attempt(order: Order) -> tuple[Outcome, bool]:
    """The outcome, and whether somebody killed the process."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(os.path.abspath(entry) for entry in sys.path)}
    if order.load == "parallel":
        environment |= dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    with tempfile.TemporaryFile() as errors:
        try:
            process = subprocess.Popen(
                [sys.executable, "-m", "warpfem.trade.worker"],
                stdin=subprocess.PIPE,  # closed when this process ends, which ends the other
                stdout=subprocess.PIPE,
                stderr=errors,
                env=environment,
                process_group=0 if os.name == "posix" else None,  # Ctrl-C is for this process to handle
            )
        except OSError as problem:
            why = f"no process could be started: {problem}"
            return Outcome(why, order.load, by_chance=True), False
        _running.add(process)
        late = threading.Event()

        def end() -> None:
            late.set()
            process.kill()

        timer = threading.Timer(order.seconds, end)
        timer.daemon = True
        assert process.stdin is not None and process.stdout is not None
        try:
            timer.start()
            with contextlib.suppress(BrokenPipeError):
                message = pickle.dumps(order, protocol=5)
                process.stdin.write(LENGTH.pack(len(message)) + message)
                process.stdin.flush()
            answer = process.stdout.read()
            status = process.wait()
        finally:
            timer.cancel()
            process.kill()
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
            process.stdout.close()
            process.wait()
            _running.discard(process)
            ended = process in _ended
            _ended.discard(process)
        if answer and status == 0:
            return pickle.loads(answer), False
        errors.seek(0)
        told = errors.read().decode(errors="replace").strip().splitlines()
    if late.is_set():
        why = f"out of time: more than {order.seconds:.0f} s"
        return Outcome(why, order.load, limit=order.seconds), False
    name = signal.Signals(-status).name if status < 0 else ""
    killed = name in KILLS
    why = f"was killed by {name}" if name else f"ended with status {status}"
    hint = " (out of memory?)" if name == "SIGKILL" else f": {told[-1]}" if told else ""
    return Outcome(f"the process {why}{hint}", order.load, by_chance=killed), killed and not ended
