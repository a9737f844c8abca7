"""The stability table: what warpfem does at the extremes, measured case by case."""

from warpfem.extremes import evaluation, parameters, recovery  # noqa: F401  each adds its cases to the table
from warpfem.extremes.table import CASES, Case, Trial

__all__ = ["CASES", "Case", "Trial"]
