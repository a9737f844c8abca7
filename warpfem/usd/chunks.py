"""A layer that grows by frames and survives a kill: chunks joined by value clips, and merged at the end."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

from pxr import Sdf, Tf, Vt

from warpfem.errors import OutputError
from warpfem.files import beside, remove, replacing, settle
from warpfem.usd.clock import Clock
from warpfem.usd.prims import WORLD
from warpfem.usd.saved import Chunk, partial_path
from warpfem.usd.stages import trust

Samples: TypeAlias = dict[Sdf.Path, Any]

# A frame that comes this long after the last save is saved at once: slow runs need not save on saving [s].
_PATIENCE = 0.5
# Merging writes to disk each time that this much has come together [bytes].
_MERGE_BYTES = 64 << 20
# What the layers of a file do not have in common.
_OWN_INFO = ("subLayers", "subLayerOffsets")


class ChunkedLayer:
    """A file in the making: ``<stem>.partial.usda``, and the folder ``<stem>.partial`` beside it.

    The folder holds the static layer, a manifest that declares what is animated, and chunk layers with the
    samples of some frames each; the ``.usda`` joins them by value clips. Each file is written under a
    temporary name and moved into place, the ``.usda`` last, so that it opens at any moment with every frame
    it names. Its paths are relative: file and folder can be moved together. Frames of an earlier file can be
    kept: its chunks stay in place, and a finished file becomes a chunk.

    Attributes:
        path: the ``.usda``.
        frame_count: the number of frames so far.
    """

    def __init__(
        self,
        output: Path,
        static: Sdf.Layer,
        animated: Iterable[Sdf.Path],
        clock: Clock,
        frames_per_chunk: int,
        metadata: dict[str, Any],
        kept: Sequence[Chunk] = (),
        base: str = "",
    ) -> None:
        """Replaces what an earlier run left under the same name, but for the frames to keep.

        Those are on disk at every moment, in the old file until they are in this one.

        Args:
            output: the file that :meth:`merge` will write.
            static: everything but samples.
            animated: the attributes of ``static`` that have samples.
            clock: the time codes of frames.
            frames_per_chunk: the most frames in one chunk.
            metadata: custom data of ``/World``; without any it is left alone.
            kept: the first frames, of this file's predecessor or of a finished one.
            base: the layer that the file goes over, relative to its folder.

        Raises:
            OSError, Tf.ErrorException, OutputError: the files cannot be written.
        """
        self._output = output
        self.path = partial_path(output)
        self._folder = beside(output, "partial")
        self._static = static
        self._animated = tuple(animated)
        self._clock = clock
        self._base = base
        self._frames_per_chunk = frames_per_chunk
        self._manifest = Sdf.Layer.CreateAnonymous(".usdc")
        for path in self._animated:
            type_name = static.GetAttributeAtPath(path).typeName
            Sdf.JustCreatePrimAttributeInLayer(self._manifest, path, type_name)

        if not kept or any(chunk.path.parent != self._folder for chunk in kept):
            self.discard()
            self._folder.mkdir(parents=True)
        self._chunks = [self._adopt(chunk) for chunk in kept]
        self.frame_count = sum(len(chunk.frames) for chunk in kept)
        self._export(static, self._folder / "static.usdc")
        self._export(self._manifest, self._folder / "manifest.usdc")
        self._pending: list[Samples] = []
        self._saved_at = time.monotonic()
        self._write_root(metadata)
        self._remove_strays()

    def append(self, samples: Samples, metadata: dict[str, Any]) -> None:
        """Adds a frame, and saves the waiting ones if there are many or the last save was some time ago.

        Args:
            samples: a value for each animated attribute.
            metadata: custom data of the default prim, which stands for all frames so far.
        """
        self._pending.append(samples)
        self.frame_count += 1
        if len(self._pending) >= self._frames_per_chunk or time.monotonic() - self._saved_at > _PATIENCE:
            self.flush(metadata)

    def flush(self, metadata: dict[str, Any]) -> None:
        """Saves the frames that wait.

        Raises:
            OSError, Tf.ErrorException, OutputError: the files cannot be written; the frames go on waiting.
        """
        if not self._pending:
            return
        frames = range(self.frame_count - len(self._pending), self.frame_count)
        layer = Sdf.Layer.CreateAnonymous(".usdc")
        layer.TransferContent(self._manifest)
        for frame, samples in zip(frames, self._pending, strict=True):
            for path, value in samples.items():
                layer.SetTimeSample(path, self._clock.code(frame), value)
        chunk = Chunk(frames, self._place(frames))
        self._export(layer, chunk.path)
        self._write_root(metadata, chunk)
        self._chunks.append(chunk)
        self._pending = []
        self._saved_at = time.monotonic()

    def merge(self, metadata: dict[str, Any], amend: Callable[[Samples], Samples]) -> None:
        """Writes the frames into the output file, in bounded memory, and removes the partial one.

        Args:
            metadata: custom data of the default prim.
            amend: gives the samples to replace, from the samples of a frame.

        Raises:
            OSError, Tf.ErrorException, OutputError: the files cannot be written; the partial file stays.
        """
        self.flush(metadata)
        self._require_folder()
        merged, text = self._folder / "merged.usdc", self._folder / "merged.usda"
        try:
            with one_reason():
                self._write_merged(merged, metadata, amend)
                if self._output.suffix == ".usda":
                    Sdf.Layer.OpenAsAnonymous(str(merged)).Export(str(text))
            settle(text if text.exists() else merged, self._output)
        finally:
            merged.unlink(missing_ok=True)
            text.unlink(missing_ok=True)
        self.discard()

    def _write_merged(self, path: Path, metadata: dict[str, Any], amend: Callable[[Samples], Samples]) -> None:
        merged = Sdf.Layer.CreateNew(str(path))
        try:
            merged.TransferContent(self._static)
            self._go_over_base(merged)
            self._describe(merged, metadata)
            unsaved = 0.0
            for chunk in self._chunks:
                layer = chunk.open()
                frame_bytes = chunk.path.stat().st_size / len(chunk.frames)
                for frame in chunk.frames:
                    code = self._clock.code(frame)
                    samples = {attribute: layer.QueryTimeSample(attribute, code) for attribute in self._animated}
                    for attribute, value in (samples | amend(samples)).items():
                        merged.SetTimeSample(attribute, code, value)
                    unsaved += frame_bytes
                    if unsaved > _MERGE_BYTES:
                        merged.Save()
                        unsaved = 0.0
            merged.Save()
        finally:
            del merged  # the traceback of an error would keep the layer open, and with it its name

    def _write_root(self, metadata: dict[str, Any], *new: Chunk) -> None:
        folder = f"./{self._folder.name}"
        chunks = [*self._chunks, *new]
        root = Sdf.Layer.CreateAnonymous(".usda")
        for key in self._static.pseudoRoot.ListInfoKeys():
            if key not in _OWN_INFO:
                root.pseudoRoot.SetInfo(key, self._static.pseudoRoot.GetInfo(key))
        root.subLayerPaths.append(f"{folder}/static.usdc")
        self._go_over_base(root)
        self._describe(root, metadata)
        if chunks:
            first, last = self._clock.code(0), self._clock.code(self.frame_count - 1)
            times = [(first, first), (last, last)] if last > first else [(first, first)]
            active = [(self._clock.code(chunk.frames[0]), float(index)) for index, chunk in enumerate(chunks)]
            clips = {
                "manifestAssetPath": Sdf.AssetPath(f"{folder}/manifest.usdc"),
                "assetPaths": Sdf.AssetPathArray([Sdf.AssetPath(f"{folder}/{chunk.path.name}") for chunk in chunks]),
                "active": Vt.Vec2dArray(active),
                "times": Vt.Vec2dArray(times),
            }
            for prim in self._static.rootPrims:
                own = {"default": {**clips, "primPath": prim.path.pathString}}
                Sdf.CreatePrimInLayer(root, prim.path).SetInfo("clips", own)
        with replacing(self.path) as temporary:  # exporting would use a temporary file of its own
            temporary.write_text(root.ExportToString(), encoding="utf-8")
        trust(self.path, map(str, self._folder.glob("*.usdc")))

    def _describe(self, layer: Sdf.Layer, metadata: dict[str, Any]) -> None:
        self._clock.author(layer, self.frame_count)
        if metadata:
            Sdf.CreatePrimInLayer(layer, WORLD).SetInfo("customData", metadata)

    def _go_over_base(self, layer: Sdf.Layer) -> None:
        if self._base:
            layer.subLayerPaths.append(self._base)
            layer.customLayerData = {**layer.customLayerData, "warpfem": {"frames": self.frame_count}}

    def discard(self) -> None:
        """Removes the partial file, with its folder."""
        remove(self.path)
        if self._folder.exists():
            shutil.rmtree(self._folder)

    def _remove_strays(self) -> None:
        """Removes what an earlier file had more: later chunks, and what a kill left half written."""
        kept = {"static.usdc", "manifest.usdc", *(chunk.path.name for chunk in self._chunks)}
        for path in self._folder.iterdir():
            if path.name not in kept and path.is_file():
                path.unlink()

    def _place(self, frames: range) -> Path:
        return self._folder / f"{frames[0]:06d}.usdc"

    def _adopt(self, chunk: Chunk) -> Chunk:
        """The chunk in this file's folder."""
        if chunk.path.parent == self._folder:
            return chunk
        own = Chunk(chunk.frames, self._place(chunk.frames))
        if chunk.path.suffix == ".usda":
            self._export(chunk.open(), own.path)
        else:
            with replacing(own.path) as temporary:
                shutil.copyfile(chunk.path, temporary)
        return own

    def _require_folder(self) -> None:
        if not self._folder.is_dir():
            raise OutputError(
                f"{self._output} cannot be written: {self._folder} has been removed, with the frames in it"
            )

    def _export(self, layer: Sdf.Layer, path: Path) -> None:
        self._require_folder()  # exporting would make it again
        with replacing(path) as temporary, one_reason():
            layer.Export(str(temporary))


@contextmanager
def one_reason() -> Iterator[None]:
    """Reduces what the USD library says of a failure, the same for every array, to the first reason."""
    try:
        yield
    except Tf.ErrorException as problem:
        raise OSError(problem.args[0].commentary.strip()) from problem
