"""Settings and fixtures of all tests."""

import signal
from pathlib import Path

import numpy as np
import pytest
import warp as wp

wp.config.log_level = wp.LOG_WARNING  # one line per kernel module otherwise
wp.set_device("cpu")


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory):
    """Keeps meshes made by the tests, and of other processes that they start, apart from the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WARPFEM_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in every test."""
    return np.random.default_rng(20)


@pytest.fixture
def interrupts():
    """Has SIGINT raise KeyboardInterrupt: a background job may have it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def bar(request, tmp_path) -> Path:
    """The scene file that the test's module has as text in ``BAR``."""
    path = tmp_path / "bar.py"
    path.write_text(request.module.BAR)
    return path
