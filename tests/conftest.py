"""Settings and fixtures of all tests."""

import numpy as np
import pytest
import warp as wp

wp.config.log_level = wp.LOG_WARNING  # one line per kernel module otherwise
wp.set_device("cpu")


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in every test."""
    return np.random.default_rng(20)
