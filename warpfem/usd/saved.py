"""The frames that an earlier run left on disk: in a partial file chunk by chunk, in a finished one as one chunk."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pxr import Sdf

from warpfem.errors import OutputError
from warpfem.files import beside
from warpfem.usd.animation import read_animation
from warpfem.usd.prims import WORLD
from warpfem.usd.stages import reporting


def partial_path(output: str | Path) -> Path:
    """Where the frames are until the output is complete."""
    return beside(Path(output), "partial.usda")


@dataclass(frozen=True)
class Chunk:
    """A layer with the samples of some frames.

    Attributes:
        frames: the frames to take from it; it may have more.
        path: the layer.
    """

    frames: range
    path: Path

    def open(self) -> Sdf.Layer:
        """The layer as it is on disk.

        Raises:
            Tf.ErrorException: it is missing or unreadable.
        """
        return Sdf.Layer.OpenAsAnonymous(str(self.path))


def saved_chunks(path: Path, frame_count: int, animated: Iterable[Sdf.Path]) -> list[Chunk]:
    """The chunks that hold the first frames of a file, partial or finished.

    Args:
        path: the file.
        frame_count: how many frames are wanted.
        animated: the attributes that each of the frames must have.

    Raises:
        OutputError: the file is missing, unreadable, or lacks some of the frames.
    """
    read_animation(path)  # which finds damage that the library does not bear
    with reporting(f"{path} cannot be read", OutputError):
        root = Sdf.Layer.OpenAsAnonymous(str(path))
        chunks = [
            Chunk(chunk.frames[: max(frame_count - chunk.frames[0], 0)], chunk.path) for chunk in _chunks(path, root)
        ]
        chunks = [chunk for chunk in chunks if len(chunk.frames)]
        found = sum(len(chunk.frames) for chunk in chunks)
        if found < frame_count:
            raise OutputError(f"{path} holds {found} of the {frame_count} frames")
        for chunk in chunks:
            if not chunk.path.is_file():
                raise OutputError(f"{path} lacks its part {chunk.path}")
            layer = chunk.open()
            for attribute in animated:
                lacking = set(chunk.frames) - set(layer.ListTimeSamplesForPath(attribute))
                if lacking:
                    raise OutputError(f"{path} lacks {attribute} in frame {min(lacking)}")
    return chunks


def _chunks(path: Path, root: Sdf.Layer) -> Iterator[Chunk]:
    last = int(root.endTimeCode)
    world = root.GetPrimAtPath(WORLD)
    if not root.subLayerPaths and world is not None:  # finished
        yield Chunk(range(last + 1), path)
        return
    clips: dict[str, Any] = world.GetInfo("clips").get("default", {}) if world is not None else {}
    starts = [int(first) for first, _ in clips.get("active", [])]
    for first, after, asset in zip(starts, [*starts[1:], last + 1], clips.get("assetPaths", []), strict=False):
        yield Chunk(range(first, after), path.parent / asset.path)
