"""Implicit schemes of second order."""

from dataclasses import dataclass

from warpfem.solvers.implicit import AdaptiveSolver, ImplicitSolver, Tableau

_GAMMA = 1.0 - 0.5**0.5
_G = 0.43586652150845899942


@dataclass(frozen=True)
class ImplicitMidpoint(ImplicitSolver):
    """The implicit midpoint rule."""

    name = "implicit_midpoint"
    order = 2
    tableau = Tableau(rows=((0.5,),), weights=(1.0,))


@dataclass(frozen=True)
class SDIRK2(AdaptiveSolver):
    """Two stages."""

    name = "sdirk2"
    order = 2
    tableau = Tableau(rows=((_GAMMA,), (1.0 - _GAMMA, _GAMMA)))


@dataclass(frozen=True)
class SDIRK3(AdaptiveSolver):
    """Three stages."""

    name = "sdirk3"
    order = 3
    tableau = Tableau(
        rows=((_G,), (0.5 * (1.0 - _G), _G), (-1.5 * _G**2 + 4.0 * _G - 0.25, 1.5 * _G**2 - 5.0 * _G + 1.25, _G))
    )
