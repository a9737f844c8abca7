"""Implicit schemes of second order."""

from dataclasses import dataclass

from warpfem.solvers.implicit import ImplicitSolver, Tableau

_GAMMA = 1.0 - 0.5**0.5


@dataclass(frozen=True)
class ImplicitMidpoint(ImplicitSolver):
    """The implicit midpoint rule."""

    name = "implicit_midpoint"
    order = 2
    tableau = Tableau(rows=((0.5,),), weights=(1.0,))


@dataclass(frozen=True)
class SDIRK2(ImplicitSolver):
    """Two stages."""

    name = "sdirk2"
    order = 2
    tableau = Tableau(rows=((_GAMMA,), (1.0 - _GAMMA, _GAMMA)))
