"""A layer that grows by frames and survives a kill: chunks joined by value clips, and merged at the end."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeAlias

from pxr import Sdf, Vt

from warpfem.usd.prims import WORLD, set_clock
from warpfem.usd.stages import trust

Samples: TypeAlias = dict[Sdf.Path, Any]

# A frame that comes this long after the last save is saved at once: slow runs need not save on saving [s].
_PATIENCE = 0.5
# Merging writes to disk each time that this much has come together [bytes].
_MERGE_BYTES = 64 << 20


class ChunkedLayer:
    """A file in the making: ``<stem>.partial.usda``, and the folder ``<stem>.partial`` beside it.

    The folder holds the static layer, a manifest that declares what is animated, and chunk layers with the
    samples of some frames each; the ``.usda`` joins them by value clips. Each file is written under a
    temporary name and moved into place, the ``.usda`` last, so that it opens at any moment with every frame
    it names. Its paths are relative: file and folder can be moved together.

    Attributes:
        path: the ``.usda``.
        frame_count: the number of frames so far.
    """

    def __init__(
        self,
        output: Path,
        static: Sdf.Layer,
        animated: Iterable[Sdf.Path],
        frames_per_chunk: int,
        metadata: dict[str, Any],
    ) -> None:
        """Replaces what an earlier run left under the same name, and writes a file without frames.

        Args:
            output: the file that :meth:`merge` will write.
            static: everything but samples.
            animated: the attributes of ``static`` that have samples.
            frames_per_chunk: the most frames in one chunk.
            metadata: custom data of the default prim.

        Raises:
            OSError, Tf.ErrorException: the files cannot be written.
        """
        self.frame_count = 0
        self._output = output
        self.path = output.with_name(f"{output.stem}.partial.usda")
        self._folder = output.with_name(f"{output.stem}.partial")
        self._static = static
        self._animated = tuple(animated)
        self._frames_per_chunk = frames_per_chunk
        self._chunks: list[range] = []
        self._manifest = Sdf.Layer.CreateAnonymous(".usdc")
        for path in self._animated:
            type_name = static.GetAttributeAtPath(path).typeName
            Sdf.JustCreatePrimAttributeInLayer(self._manifest, path, type_name)

        self._remove()
        self._folder.mkdir(parents=True)
        _export(static, self._folder / "static.usdc")
        _export(self._manifest, self._folder / "manifest.usdc")
        self._start_chunk()
        self._write_root(metadata)

    def append(self, samples: Samples, metadata: dict[str, Any]) -> None:
        """Adds a frame, and saves the waiting ones if there are many or the last save was some time ago.

        Args:
            samples: a value for each animated attribute.
            metadata: custom data of the default prim, which stands for all frames so far.
        """
        for path, value in samples.items():
            self._pending.SetTimeSample(path, self.frame_count, value)
        self.frame_count += 1
        full = self.frame_count - self._first_pending >= self._frames_per_chunk
        if full or time.monotonic() - self._saved_at > _PATIENCE:
            self._save_chunk(metadata)

    def merge(self, metadata: dict[str, Any], amend: Callable[[Samples], Samples]) -> None:
        """Writes the frames into the output file, in bounded memory, and removes the partial one.

        Args:
            metadata: custom data of the default prim.
            amend: gives the samples to replace, from the samples of a frame.

        Raises:
            OSError, Tf.ErrorException: the files cannot be written; the partial file stays.
        """
        if self._first_pending < self.frame_count:
            self._save_chunk(metadata)
        merged = self._folder / "merged.usdc"
        try:
            self._write_merged(merged, metadata, amend)
            if self._output.suffix == ".usda":
                text = merged.with_suffix(".usda")
                Sdf.Layer.OpenAsAnonymous(str(merged)).Export(str(text))
                os.replace(text, merged)
            os.replace(merged, self._output)
        finally:
            merged.unlink(missing_ok=True)
        self._remove()

    def _write_merged(self, path: Path, metadata: dict[str, Any], amend: Callable[[Samples], Samples]) -> None:
        merged = Sdf.Layer.CreateNew(str(path))
        merged.TransferContent(self._static)
        self._describe(merged, metadata)
        unsaved = 0
        for frames in self._chunks:
            chunk_path = self._folder / _chunk_name(frames)
            chunk = Sdf.Layer.OpenAsAnonymous(str(chunk_path))
            for frame in frames:
                samples = {attribute: chunk.QueryTimeSample(attribute, frame) for attribute in self._animated}
                for attribute, value in (samples | amend(samples)).items():
                    merged.SetTimeSample(attribute, frame, value)
            unsaved += chunk_path.stat().st_size
            if unsaved > _MERGE_BYTES:
                merged.Save()
                unsaved = 0
        merged.Save()

    def _start_chunk(self) -> None:
        self._pending = Sdf.Layer.CreateAnonymous(".usdc")
        self._pending.TransferContent(self._manifest)
        self._first_pending = self.frame_count
        self._saved_at = time.monotonic()

    def _save_chunk(self, metadata: dict[str, Any]) -> None:
        frames = range(self._first_pending, self.frame_count)
        _export(self._pending, self._folder / _chunk_name(frames))
        self._chunks.append(frames)
        self._start_chunk()
        self._write_root(metadata)

    def _write_root(self, metadata: dict[str, Any]) -> None:
        folder = f"./{self._folder.name}"
        root = Sdf.Layer.CreateAnonymous(".usda")
        for key in ("defaultPrim", "metersPerUnit", "upAxis"):
            root.pseudoRoot.SetInfo(key, self._static.pseudoRoot.GetInfo(key))
        root.subLayerPaths.append(f"{folder}/static.usdc")
        self._describe(root, metadata)
        if self._chunks:
            last = float(self.frame_count - 1)
            times = [(0.0, 0.0), (last, last)] if last > 0.0 else [(0.0, 0.0)]
            active = [(float(frames[0]), float(index)) for index, frames in enumerate(self._chunks)]
            clips = {
                "primPath": WORLD.pathString,
                "manifestAssetPath": Sdf.AssetPath(f"{folder}/manifest.usdc"),
                "assetPaths": Sdf.AssetPathArray(
                    [Sdf.AssetPath(f"{folder}/{_chunk_name(frames)}") for frames in self._chunks]
                ),
                "active": Vt.Vec2dArray(active),
                "times": Vt.Vec2dArray(times),
            }
            root.GetPrimAtPath(WORLD).SetInfo("clips", {"default": clips})
        _export(root, self.path)
        trust(self.path, map(str, self._folder.glob("*.usdc")))

    def _describe(self, layer: Sdf.Layer, metadata: dict[str, Any]) -> None:
        set_clock(layer, self._static.framesPerSecond, self.frame_count)
        Sdf.CreatePrimInLayer(layer, WORLD).SetInfo("customData", metadata)

    def _remove(self) -> None:
        self.path.unlink(missing_ok=True)
        if self._folder.exists():
            shutil.rmtree(self._folder)


def _chunk_name(frames: range) -> str:
    return f"{frames[0]:06d}.usdc"


def _export(layer: Sdf.Layer, path: Path) -> None:
    temporary = path.with_name(f"writing.{path.name}")
    layer.Export(str(temporary))
    os.replace(temporary, path)
