"""A bear falls on a floor.

Physics: stable Neo-Hookean elasticity, gravity, penalty contact with Coulomb friction; backward Euler.
Units: SI. The closed surface ``bear.usd`` that comes with warp-lang, scaled to a height of 1 m and filled with
tetrahedra by pytetwild (extra ``tet``); without pytetwild a box of that size takes its place.
Tested: it comes to the floor and stays on it: the lowest point is within 2 % of its height of the floor.
"""

import sys
from pathlib import Path

import numpy as np

import warpfem as wf

SIZE = np.array([4.89, 5.542, 9.78])  # of the file, without a unit


def mesh(edge_length: float) -> wf.Mesh:
    import warp.examples

    height = SIZE[1]
    path = Path(warp.examples.get_asset_directory()) / "bear.usd"
    try:
        return wf.load_mesh(path, scale=1 / height, edge_length=edge_length)
    except wf.MissingExtraError as error:
        print(f"bear: a box takes the bear's place, because {error}", file=sys.stderr)
        return wf.Mesh.box(SIZE / height, np.ceil(SIZE / height / edge_length).astype(int))


def scene(
    edge_length: float = 0.1,
    E: float = 3e5,
    nu: float = 0.4,
    height: float = 0.4,
    tilt: float = 20.0,
    friction: float = 0.6,
    dt: float = 1 / 96,
    frames: int = 48,
) -> wf.Scene:
    bear = mesh(edge_length)
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    tilted = (bear.points - bear.bounding_box.mean(axis=0)) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T
    tilted[:, 1] += height - tilted[:, 1].min()
    bear = wf.Mesh(tilted, bear.cells)
    return wf.Scene(
        [wf.Body("bear", bear, wf.StableNeoHookean(E=E, nu=nu), density=300)],
        wf.BackwardEuler(),
        dt=dt,
        gravity=(0, -9.81, 0),
        obstacles=[wf.Plane(point=(0, 0, 0), normal=(0, 1, 0), friction=friction)],
        frames=frames,
    )


if __name__ == "__main__":
    print(wf.run(scene(), "bear.usdc"))
