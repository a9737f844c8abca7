"""The bodies that contenders are given, as arrays."""

from typing import Any

import numpy as np

import warpfem as wf


def _body(mesh: wf.Mesh, E: float, nu: float, density: float, fixed: np.ndarray) -> dict[str, Any]:
    return {
        "points": mesh.points,
        "cells": mesh.cells,
        "fixed": fixed,
        "E": E,
        "nu": nu,
        "density": density,
    }


def shaken_cube(cells_per_side: int) -> dict[str, Any]:
    """A cube fixed on one side, waves of 2 % of its size as the initial displacement, and a stable time step."""
    mesh = wf.Mesh.box((1.0, 1.0, 1.0), (cells_per_side,) * 3, split=6)
    X = mesh.points
    waves = np.stack([np.sin(3 * X[:, 1]), np.sin(4 * X[:, 2]), np.cos(3 * X[:, 0])], axis=1)
    problem = _body(mesh, 1e5, 0.3, 1000.0, X[:, 0] == 0.0)
    return {**problem, "u": 0.02 * X[:, :1] * waves, "dt": 0.06 / cells_per_side / 11.6}


def cantilever(cells: tuple[int, int, int], size: tuple[float, float, float], E: float, nu: float) -> dict[str, Any]:
    """A beam along x, held at x = 0, at rest, under gravity along -y."""
    mesh = wf.Mesh.box(size, cells, split=5)
    return {**_body(mesh, E, nu, 1000.0, mesh.points[:, 0] == 0.0), "gravity": -9.81}
