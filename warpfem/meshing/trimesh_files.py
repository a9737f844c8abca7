"""Surface files by trimesh: .obj, .stl, .ply, .off, .glb and .gltf. Its functions run in a child process."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from warpfem.child import DAMAGED
from warpfem.errors import MeshError, described
from warpfem.meshing.contents import Surface

SUFFIXES = {".obj", ".stl", ".ply", ".off", ".glb", ".gltf"}

_GLTF = {".glb", ".gltf"}  # in metres and Y up by their standard


def read(path: str) -> Surface:
    """All triangles of a file as one surface, those of a scene where its transforms put them.

    Raises:
        MeshError: the file is damaged, or has no faces.
    """
    try:
        parts = _parts(Path(path))
    except Exception as error:  # trimesh raises anything on damaged files
        raise MeshError(f"{path}: {DAMAGED} ({described(error)})") from error
    if not parts:
        raise MeshError(f"{path}: the file holds no faces")
    offsets = np.cumsum([0, *(len(points) for points, _ in parts[:-1])])
    triangles = [faces + offset for (_, faces), offset in zip(parts, offsets, strict=True)]
    up_axis: Any = "Y" if Path(path).suffix.lower() in _GLTF else None
    return Surface(np.concatenate([points for points, _ in parts]), np.concatenate(triangles), up_axis)


def _parts(path: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points and triangles of each instance of a geometry in the file."""
    import trimesh

    if check := _CHECKS.get(path.suffix.lower()):
        check(path.read_bytes())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # what NumPy says of text that is not the number that should be there, and then leaves out
        warnings.filterwarnings("error", "string or file could not be read to its end")
        scene = trimesh.load_scene(path, process=False, skip_materials=True)
    parts = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            points = np.asarray(geometry.vertices, dtype=np.float64)
            parts.append((points @ matrix[:3, :3].T + matrix[:3, 3], np.asarray(geometry.faces)))
    return parts


# ---- what trimesh does not notice: each raises ValueError


def _check_stl(content: bytes) -> None:
    triangle_count = int.from_bytes(content[80:84], "little")
    is_binary = len(content) >= 84 and len(content) == 84 + 50 * triangle_count  # even if it starts as the text does
    words = content[:100].split(maxsplit=1)[:1] + content.rstrip().rsplit(b"\n", 1)[-1].split(maxsplit=1)[:1]
    if not is_binary and [word.lower() for word in words] != [b"solid", b"endsolid"]:
        raise ValueError("a part is missing")


def _check_ply(content: bytes) -> None:
    header, _, body = content.partition(b"end_header")
    counts = re.findall(rb"^\s*element\s+\w+\s+(\d+)", header, re.MULTILINE)
    faces_last = re.search(rb"element\s+face\s+\d+\s+property\s+list[^\n]*\s*\Z", header)
    if re.search(rb"^\s*format\s+ascii", header, re.MULTILINE):
        _check_rows(body, sum(map(int, counts)), faces_last is not None)


def _check_off(content: bytes) -> None:
    rows = re.sub(rb"#[^\n]*", b"", content).partition(b"OFF")[2]
    counts = re.match(rb"\s*(\d+)\s+(\d+)[^\n]*", rows)
    if counts:
        _check_rows(rows[counts.end() :], int(counts[1]) + int(counts[2]), True)


def _check_rows(text: bytes, count: int, faces_last: bool) -> None:
    rows = [line for line in text.splitlines() if line.strip()]
    last = rows[count - 1].split() if 0 < count <= len(rows) else []
    if len(rows) < count or (faces_last and count and len(last) <= int(last[0])):
        raise ValueError("a part is missing")


def _check_obj(content: bytes) -> None:
    if re.search(rb"^\s*f\s(?:[^\n]*\s)?0(?=[/\s]|\Z)", content, re.MULTILINE):
        raise ValueError("a face refers to vertex 0, and they count from 1")


_CHECKS: dict[str, Callable[[bytes], None]] = {
    ".stl": _check_stl,
    ".ply": _check_ply,
    ".off": _check_off,
    ".obj": _check_obj,
}
