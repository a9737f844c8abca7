"""Where settings run: in processes of this machine, or on a Dask cluster that exists already."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager

from warpfem.errors import MissingExtraError, OutputError
from warpfem.trade.process import end_all

PATIENCE = "10s"
"""How long a scheduler may take to answer."""


@contextmanager
def local_executor(workers: int) -> Iterator[Executor]:
    """Threads of this process, each of which waits for one process at a time.

    Args:
        workers: settings that run at the same time.
    """
    executor = ThreadPoolExecutor(workers)
    try:
        yield executor
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        end_all()
        raise
    executor.shutdown()


@contextmanager
def cluster_executor(address: str) -> Iterator[Executor]:
    """The workers of an existing Dask cluster, which read the scene file under the same path.

    Args:
        address: of its scheduler, for example ``tcp://10.0.0.1:8786``.

    Raises:
        MissingExtraError: Dask is not installed.
        OutputError: there is no scheduler.
    """
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtraError("--scheduler", "distributed", "cluster") from None
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OutputError(f"no Dask scheduler answers at {address}: {error}") from None
    with client:
        executor = client.get_executor(pure=False)
        try:
            yield executor
        finally:
            executor.shutdown(wait=False)
