"""Steps of the C++ limit: one of its variants for each contender."""

import subprocess
import tempfile
from pathlib import Path

import numpy as np
from serving import Contender, serve


def write_mesh(path, problem, material):
    """The problem as limit.cpp reads it."""
    points, cells = problem["points"], problem["cells"]
    E, nu = float(problem["E"]), float(problem["nu"])
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    parameters = (4 / 3 * mu, lam + 5 / 6 * mu) if material == "stable_neo_hookean" else (mu, lam)
    shapes = np.swapaxes(points[cells[:, 1:]] - points[cells[:, :1]], 1, 2)
    volumes = np.abs(np.linalg.det(shapes)) / 6
    masses = np.zeros(len(points))
    np.add.at(masses, cells, float(problem["density"]) * volumes[:, None] / 4)
    with open(path, "wb") as file:
        for content, dtype in (
            ([len(cells), len(points)], np.int64),
            (cells, np.int32),
            (np.linalg.inv(shapes), np.float32),
            (volumes[:, None] * parameters, np.float32),
            (np.where(problem["fixed"], 0.0, 1.0 / masses), np.float32),
            (problem["u"], np.float32),
            ([problem["dt"]], np.float32),
        ):
            file.write(np.ascontiguousarray(content, dtype=dtype).tobytes())


def setup(problem, options):
    folder = tempfile.TemporaryDirectory()
    mesh, forces, displacement = (str(Path(folder.name, name)) for name in ("mesh", "forces", "displacement"))
    write_mesh(mesh, problem, options["material"])
    command = [options["binary"], mesh, options["material"], options["variant"], str(options["threads"])]
    command += [str(options["steps"]), "1", forces, displacement]

    def run():
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return {"seconds": float(done.stdout) / options["steps"]}

    def outcome():
        folder.name  # noqa: B018 - the folder lives as long as this does
        return {
            "forces": np.fromfile(forces, np.float32).reshape(-1, 3),
            "displacement": np.fromfile(displacement, np.float32).reshape(-1, 3),
        }

    return Contender(run, outcome)


serve(setup)
