"""All cases, in the order of the page."""

import warp as wp

from verification import cantilever, contact, cook, frequencies, homogeneous, manufactured, other_codes, spin
from verification.core import Outcome, run_case

_MODULES = (manufactured, homogeneous, other_codes, cook, cantilever, frequencies, contact, spin)

CASES = {module.CASE.name: module.CASE for module in _MODULES}


def run_named(name: str, quick: bool) -> Outcome:
    """Runs a case by its name, as processes of their own do."""
    wp.config.log_level = wp.LOG_ERROR
    return run_case(CASES[name], quick)
