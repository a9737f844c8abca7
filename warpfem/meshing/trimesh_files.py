"""Surface files by trimesh: .obj, .stl, .ply, .off, .glb and .gltf. Its functions run in a child process."""

from __future__ import annotations

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

    is_whole = _IS_WHOLE.get(path.suffix.lower())
    if is_whole and not is_whole(path.read_bytes()):
        raise EOFError("a part is missing")
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


# What a whole file has: without it, trimesh takes a part for the whole.


def _whole_stl(content: bytes) -> bool:
    triangle_count = int.from_bytes(content[80:84], "little")
    if len(content) >= 84 and len(content) == 84 + 50 * triangle_count:
        return True  # binary, even if it starts with the word of the text format
    words = content[:100].split(maxsplit=1)[:1] + content.rstrip().rsplit(b"\n", 1)[-1].split(maxsplit=1)[:1]
    return [word.lower() for word in words] == [b"solid", b"endsolid"]


_IS_WHOLE: dict[str, Callable[[bytes], bool]] = {".stl": _whole_stl}
