"""Damaged files by the hundred: small valid ones, a seeded generator that damages them, and a process to read them in.

``python tests/fuzzing.py [KIND,...] COUNT SEED`` tries as many of each kind as one likes.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpfem.boundary import Plane, Sphere
from warpfem.child import DAMAGED, limit_resources
from warpfem.errors import MeshError, WarpfemError
from warpfem.mesh import Mesh

PATIENCE = 20.0
"""Seconds until a reader in a batch counts as hanging."""

NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
BAD_NUMBERS = [b"-1", b"0", b"nan", b"inf", b"1e308", b"-7", b"4294967296", b"999999999999", b"1e12", b"", b"x", b"2 2"]
BAD_INTEGERS = [0, 1, -1, 2**31 - 1, -(2**31), 2**20, 2**32, 10**12, 2**63 - 1, -(2**63), 255, 65535]
BAD_FLOATS = [np.nan, np.inf, -np.inf, 1e308, -1e30, 1e-310]


# ---- damage


def mutant(content: bytes, rng: np.random.Generator) -> bytes:
    """The content with one to four kinds of damage."""
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        damage = DAMAGES[rng.integers(len(DAMAGES))]
        content = damage(content, rng)
    return content


def _span(content: bytes, rng: np.random.Generator) -> tuple[int, int]:
    start = int(rng.integers(len(content) + 1))
    return start, min(len(content), start + int(2 ** rng.uniform(0, 9)))


def _flip_bits(content: bytes, rng: np.random.Generator) -> bytes:
    data = bytearray(content)
    for _ in range(rng.integers(1, 9)):
        if data:
            data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    return bytes(data)


def _truncate(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: int(rng.integers(len(content) + 1))]


def _delete(content: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(content, rng)
    return content[:start] + content[end:]


def _duplicate(content: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(content, rng)
    return content[:end] + content[start:end] * int(rng.choice([1, 1, 1000])) + content[end:]


def _overwrite(content: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(content, rng)
    filling = rng.bytes(end - start) if rng.random() < 0.5 else bytes([rng.choice([0, 32, 255])]) * (end - start)
    return content[:start] + filling + content[end:]


def _swap_lines(content: bytes, rng: np.random.Generator) -> bytes:
    lines = content.splitlines(keepends=True)
    if len(lines) > 1:
        a, b = rng.integers(len(lines), size=2)
        lines[a], lines[b] = lines[b], lines[a]
    return b"".join(lines)


def _replace_number(content: bytes, rng: np.random.Generator) -> bytes:
    places = list(NUMBER.finditer(content))
    if not places:
        return _replace_binary_number(content, rng)
    place = places[int(len(places) * rng.random() ** 3)]  # headers are at the front
    return content[: place.start()] + BAD_NUMBERS[rng.integers(len(BAD_NUMBERS))] + content[place.end() :]


def _replace_binary_number(content: bytes, rng: np.random.Generator) -> bytes:
    size = int(rng.choice([4, 8]))
    if rng.random() < 0.8:
        number = BAD_INTEGERS[rng.integers(len(BAD_INTEGERS))] % 2 ** (8 * size)
        data = number.to_bytes(size, "little" if rng.random() < 0.9 else "big")
    else:
        with np.errstate(over="ignore"):
            data = np.array(BAD_FLOATS[rng.integers(len(BAD_FLOATS))], f"<f{size}").tobytes()
    start = int(rng.integers(max(1, len(content) - size)))
    return content[:start] + data + content[start + size :]


DAMAGES: list[Callable[[bytes, np.random.Generator], bytes]] = [
    _flip_bits,
    _truncate,
    _delete,
    _duplicate,
    _overwrite,
    _swap_lines,
    _replace_number,
    _replace_number,
    _replace_binary_number,
]


# ---- valid files


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        reader: the name of a function below that reads it.
        write: writes a valid one in a folder; returns the path that the reader takes.
    """

    reader: str
    write: Callable[[Path], Path]


def _meshio_file(name: str, surface: bool = False, **arguments: object) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        import meshio

        mesh = Mesh.box((1.0, 2.0, 1.0), (1, 2, 1))
        kind, cells = ("triangle", mesh.boundary_faces) if surface else ("tetra", mesh.cells)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            meshio.write_points_cells(folder / name, mesh.points, [(kind, cells)], **arguments)
        return folder / name

    return write


def _trimesh_file(name: str, **arguments: object) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        import trimesh

        mesh = Mesh.box((1.0, 2.0, 1.0), (1, 2, 1))
        scene = trimesh.Scene(trimesh.Trimesh(mesh.points, mesh.boundary_faces, process=False))
        (scene if name.startswith("a.gl") else scene.to_mesh()).export(folder / name, **arguments)
        return folder / name

    return write


def _text_file(name: str, text: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_text(text)
        return folder / name

    return write


def _tets(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        from pxr import Gf, Usd, UsdGeom, UsdUtils, Vt

        mesh = Mesh.box((1.0, 2.0, 1.0), (1, 2, 1))
        path = folder / name
        authored = path.with_suffix(".usdc") if path.suffix == ".usdz" else path
        stage = Usd.Stage.CreateNew(str(authored))
        UsdGeom.SetStageMetersPerUnit(stage, 0.01)
        UsdGeom.Xform.Define(stage, "/root").AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
        tets = UsdGeom.TetMesh.Define(stage, "/root/tets")
        tets.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(mesh.points.astype(np.float32)))
        tets.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(mesh.cells))
        surface = UsdGeom.Mesh.Define(stage, "/root/surface")
        surface.CreatePointsAttr(tets.GetPointsAttr().Get())
        surface.CreateFaceVertexCountsAttr([3] * len(mesh.boundary_faces))
        surface.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.boundary_faces.ravel()))
        stage.Save()
        del stage
        if path != authored:
            UsdUtils.CreateNewUsdzPackage(str(authored), str(path))
            authored.unlink()
        return path

    return write


def animation(name: str, dim: int = 3, finish: bool = True) -> Callable[[Path], Path]:
    """A finished animation, or the partial one of a killed run."""

    def write(folder: Path) -> Path:
        from warpfem.usd import BodyFrame, UsdBody, UsdWriter

        mesh = Mesh.box((1.0, 1.0, 1.0), (1, 1, 1)) if dim == 3 else Mesh.rectangle((1.0, 1.0), (2, 2))
        body = UsdBody("block", mesh.points, mesh.cells, mesh.boundary_faces if dim == 3 else mesh.cells)
        up = np.eye(dim)[1]
        obstacles = [Plane(-0.5 * up, up), Sphere(2.0 * up, 0.3)]
        writer = UsdWriter(folder / name, [body], fps=24, frames_per_chunk=2, obstacles=obstacles)
        for index in range(6):
            moved = mesh.points + 0.05 * index * up
            stress, ratio = np.linspace(0.0, 1e3, mesh.cell_count), np.full(mesh.cell_count, 1.0 + 0.01 * index)
            writer.write_frame([BodyFrame(moved, np.zeros_like(moved), stress, ratio)])
        return writer.close() if finish else (folder / name).with_suffix(".partial.usda")

    return write


SETS = (
    "*NODE\n1, 0, 0, 0\n2, 1, 0, 0\n3, 1, 1, 0\n4, 0, 1, 0\n*ELEMENT, TYPE=CPS3, ELSET=first\n1, 1, 2, 3\n2, 1, 3, 4\n"
    "*NSET, NSET=end\n3, 4\n*ELSET, ELSET=all\n1, 2\n"
)
GROUPS_22 = (
    '$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n2\n2 7 "base"\n3 1 "all"\n$EndPhysicalNames\n$Nodes\n5\n'
    "1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n5 1 1 1\n$EndNodes\n$Elements\n4\n1 15 2 4 1 5\n2 2 2 7 1 1 2 3\n"
    "3 4 2 1 1 1 2 3 4\n4 4 2 9 2 2 3 5 4\n$EndElements\n"
)
GROUPS_41 = (
    '$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$PhysicalNames\n1\n3 1 "all"\n$EndPhysicalNames\n$Entities\n0 0 0 1\n'
    "1 0 0 0 1 1 1 1 1 0\n$EndEntities\n$Nodes\n1 4 1 4\n3 1 0 4\n1\n2\n3\n4\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n$EndNodes\n"
    "$Elements\n1 1 1 1\n3 1 4 1\n1 1 2 3 4\n$EndElements\n"
)

MESH_KINDS = {
    "msh22": Kind("solid", _text_file("a.msh", GROUPS_22)),
    "msh41": Kind("solid", _text_file("a.msh", GROUPS_41)),
    "msh22-binary": Kind("solid", _meshio_file("a.msh", file_format="gmsh22", binary=True)),
    "msh41-binary": Kind("solid", _meshio_file("a.msh", file_format="gmsh", binary=True)),
    "vtu": Kind("solid", _meshio_file("a.vtu")),
    "vtu-text": Kind("solid", _meshio_file("a.vtu", binary=False)),
    "vtk": Kind("solid", _meshio_file("a.vtk")),
    "vtk-text": Kind("solid", _meshio_file("a.vtk", binary=False)),
    "vtk42": Kind("solid", _meshio_file("a.vtk", file_format="vtk42")),
    "medit": Kind("solid", _meshio_file("a.mesh")),
    "medit-binary": Kind("solid", _meshio_file("a.meshb")),
    "abaqus": Kind("solid", _text_file("a.inp", SETS)),
    "vtu-surface": Kind("surface", _meshio_file("a.vtu", surface=True)),
    "obj": Kind("surface", _trimesh_file("a.obj")),
    "ply": Kind("surface", _trimesh_file("a.ply")),
    "ply-text": Kind("surface", _trimesh_file("a.ply", encoding="ascii")),
    "stl": Kind("surface", _trimesh_file("a.stl")),
    "stl-text": Kind("surface", _trimesh_file("a.stl", file_type="stl_ascii")),
    "off": Kind("surface", _trimesh_file("a.off")),
    "glb": Kind("surface", _trimesh_file("a.glb")),
    "gltf": Kind("surface", _trimesh_file("a.gltf", embed_buffers=True)),
}
USD_KINDS = {
    "usda": Kind("solid", _tets("a.usda")),
    "usdc": Kind("solid", _tets("a.usdc")),
    "usdz": Kind("solid", _tets("a.usdz")),
    "usda-surface": Kind("surface", _tets("a.usda")),
    "usdc-surface": Kind("surface", _tets("a.usdc")),
    "animation-usda": Kind("animation", animation("a.usda")),
    "animation-usdc": Kind("animation", animation("a.usdc")),
    "animation-2D": Kind("animation", animation("a.usdc", dim=2)),
    "partial": Kind("animation", animation("a.usdc", finish=False)),
    "preview-usda": Kind("picture", animation("a.usda")),
    "preview-2D": Kind("picture", animation("a.usda", dim=2)),
    "preview-partial": Kind("picture", animation("a.usdc", finish=False)),
}
KINDS = MESH_KINDS | USD_KINDS


def mutants(kind: Kind, folder: Path, count: int, seed: int) -> list[Path]:
    """Damaged files in folders of their own."""
    valid = folder / "valid"
    valid.mkdir(parents=True)
    path = kind.write(valid).relative_to(valid)
    rng = np.random.default_rng(seed)
    made = []
    for number in range(count):
        copy = folder / str(number)
        shutil.copytree(valid, copy)
        files = sorted(file for file in copy.rglob("*") if file.is_file())
        victim = files[rng.integers(len(files))]
        victim.write_bytes(mutant(victim.read_bytes(), rng))
        made.append(copy / path)
    return made


# ---- reading


def solid(path: Path) -> None:
    """Reads a mesh, which is valid then."""
    from warpfem.meshing import files

    files.tetrahedralize = _leave_empty  # damage can make a surface of a solid
    files.load_mesh(path)


def _leave_empty(*surface: object) -> None:
    raise MeshError("not here")


def surface(path: Path) -> None:
    """Reads a surface, whose indices are in range and whose points are finite then."""
    from warpfem import read_surface

    points, triangles = read_surface(path)
    assert np.isfinite(points).all() and points.shape[1] == 3
    assert triangles.shape[1] == 3 and triangles.min() >= 0 and triangles.max() < len(points)


def play(path: Path) -> None:
    """Reads all frames of an animation."""
    from warpfem.usd import read_animation

    film = read_animation(path)
    for index in range(film.frame_count):
        for body, frame in zip(film.bodies, film.frame(index), strict=True):
            assert np.isfinite(frame.points).all() and frame.points.shape == body.rest_points.shape
            assert body.cells.min() >= 0 and body.cells.max() < len(frame.points)


def picture(path: Path) -> None:
    """Draws an animation."""
    from warpfem.preview import preview

    preview(path, path.parent / "out.png")


READERS = {"solid": solid, "surface": surface, "animation": play, "picture": picture}


def _read_here(read: Callable, path: Path, error: type[WarpfemError]) -> object:
    """``read_in_child`` without the child."""
    try:
        return read(str(path))
    except WarpfemError:
        raise
    except BaseException as problem:
        raise error(f"{path}: {DAMAGED} ({problem})") from problem


def read_batch(reader: str, children: bool) -> None:
    """Reads the files whose names come by the standard input; says of each how it went."""
    report = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    warnings.simplefilter("ignore")
    if not children:
        from warpfem.meshing import files
        from warpfem.usd import animation, meshes

        for module in (files, animation, meshes):
            module.read_in_child = _read_here
        limit_resources(1e6)
    for line in sys.stdin:
        try:
            READERS[reader](Path(json.loads(line)))
            answer = "valid"
        except WarpfemError as error:
            answer = f"refused: {error}"
        except BaseException:
            answer = f"LEAKED: {traceback.format_exc()}"
        print(json.dumps(answer), file=report, flush=True)


def answers(reader: str, paths: list[Path], children: bool = False) -> Iterator[str]:
    """What became of each file: valid, refused, LEAKED, died or hung."""
    waiting = list(paths)
    while waiting:
        with subprocess.Popen(
            [sys.executable, __file__, "--batch", reader, str(int(children))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        ) as process:
            while waiting:
                hung = threading.Event()
                timer = threading.Timer(1e3 if children else PATIENCE, lambda h=hung, p=process: (h.set(), p.kill()))
                timer.start()
                with contextlib.suppress(BrokenPipeError):
                    process.stdin.write(json.dumps(str(waiting[0])) + "\n")
                    process.stdin.flush()
                line = process.stdout.readline()
                timer.cancel()
                waiting.pop(0)
                if not line:
                    yield "hung" if hung.is_set() else f"died with {process.wait()}"
                    break
                yield json.loads(line)
            process.kill()


def main(kinds: list[str], count: int, seed: int) -> None:
    """Tries many, and prints what is not right, and where its file is."""
    for name in kinds:
        kind = KINDS[name]
        folder = Path(tempfile.mkdtemp(prefix=f"fuzz-{name}-"))
        paths = mutants(kind, folder, count, seed)
        counts: dict[str, int] = {}
        ends = []
        for path, answer in zip(paths, answers(kind.reader, paths), strict=True):
            word = answer.split(":")[0]
            counts[word] = counts.get(word, 0) + 1
            if word not in ("valid", "refused"):
                ends.append(path)
            if word in ("LEAKED", "hung"):
                print(f"{path}: {answer}")
        print(f"{name}: {counts}", flush=True)
        for path, answer in zip(ends, answers(kind.reader, ends, children=True), strict=True):
            if not answer.startswith(("refused", "valid")):
                print(f"  WITH CHILD {path}: {answer}", flush=True)
        for path in paths:
            if path not in ends:
                shutil.rmtree(path.parent)


if __name__ == "__main__":
    if sys.argv[1] == "--batch":
        read_batch(sys.argv[2], bool(int(sys.argv[3])))
    else:
        main(sys.argv[1].split(",") if len(sys.argv) > 3 else list(KINDS), *map(int, sys.argv[-2:]))
