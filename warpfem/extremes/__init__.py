"""The stability table: what warpfem does at the extremes, measured case by case."""

from warpfem.extremes import (  # noqa: F401  each adds its cases to the table
    dynamics,
    evaluation,
    parameters,
    recovery,
    robustness,
    scale,
)
from warpfem.extremes.table import CASES, Case, Trial

__all__ = ["CASES", "Case", "Trial"]
