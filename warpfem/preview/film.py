"""Films: the frames of a motion one after the other, as GIF or MP4."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from warpfem.errors import MissingExtraError, OutputError, one_line
from warpfem.preview.coloring import Coloring
from warpfem.preview.page import Page
from warpfem.preview.scene import Scene

_SLOW_MOTION, _LEAST_RATE = 25.0, 2.0
"""Frames per second: of runs of less than a second at most, and of any film at least."""
_QUALITY = "18"
"""Constant rate factor of x264: 0 is lossless, 51 the worst."""


class Film:
    """The frames of a film.

    Attributes:
        chosen: the frames of the motion that are shown.
        times: when each of them begins, and when the last one ends [s of the film], (len(chosen) + 1,).
    """

    def __init__(self, coloring: Coloring, scene: Scene, most: int, shortest: float) -> None:
        """Chooses the frames.

        Args:
            coloring: the motion and its colours.
            scene: what draws its frames.
            most: the most frames.
            shortest: how long a frame is shown at least [s]: viewers slow down shorter ones.
        """
        stage = coloring.stage
        self._scene, self._page = scene, Page(coloring, scene.view, 1)
        rate = stage.fps
        if stage.frame_count < rate:
            rate = min(rate, _SLOW_MOTION)
        rate = _LEAST_RATE if stage.equilibria else max(rate, _LEAST_RATE)
        stride = max(math.ceil(stage.frame_count / most), math.ceil(shortest * rate))
        self.chosen = range(0, stage.frame_count, stride)
        self.times = np.array([*self.chosen, stage.frame_count]) / rate
        self.rate = rate / stride
        self._pace = "" if stage.equilibria else _pace(rate / stage.fps)

    def images(self) -> Iterator[np.ndarray]:
        """The frames with what is around them: (height, width, 3) uint8 each."""
        for index in self.chosen:
            self._page.show([self._scene.image(index)], [index], self._pace)
            yield self._page.pixels()


def _pace(ratio: float) -> str:
    """What is said of a film that runs at ``ratio`` times the speed of the motion."""
    if abs(ratio - 1.0) < 1e-6:
        return ""
    return f", {1.0 / ratio:.3g} x slower" if ratio < 1.0 else f", {ratio:.3g} x faster"


def write_gif(path: Path, film: Film) -> None:
    """Writes a film as GIF, with one palette for all frames, or colours would flicker.

    Raises:
        OSError: the file cannot be written.
    """
    from PIL import Image

    images = [Image.fromarray(image) for image in film.images()]
    some = np.concatenate([np.asarray(image) for image in images[:: math.ceil(len(images) / 8)]])
    palette = Image.fromarray(some).quantize(256, Image.Quantize.FASTOCTREE)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    # GIF counts hundredths of a second: rounding the times keeps the pace where rounding the delays would not.
    delays = np.diff(10 * np.round(100.0 * film.times).astype(int)).tolist()
    images[0].save(path, "GIF", save_all=True, append_images=images[1:], duration=delays, loop=0)


def require_encoder() -> None:
    """Checks that films can be written as MP4.

    Raises:
        MissingExtraError: imageio-ffmpeg is not installed.
        OutputError: it comes without its program.
    """
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise MissingExtraError("a film as .mp4", "imageio-ffmpeg", "video") from error
    try:
        imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise OutputError(f"imageio-ffmpeg does not find its program: {one_line(str(error))}. Take .gif") from error


def write_mp4(path: Path, film: Film) -> None:
    """Writes a film as MP4 (H.264, which all browsers play), at a constant rate.

    Raises:
        OSError: the file cannot be written.
    """
    import imageio_ffmpeg

    encoder = None
    try:
        for image in film.images():
            height, width = image.shape[:2]
            even = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")  # as H.264 wants it
            if encoder is None:
                encoder = imageio_ffmpeg.write_frames(
                    str(path),
                    (even.shape[1], even.shape[0]),
                    fps=film.rate,
                    codec="libx264",
                    quality=None,
                    macro_block_size=1,
                    output_params=["-crf", _QUALITY],
                    ffmpeg_log_level="error",
                )
                encoder.send(None)
            encoder.send(np.ascontiguousarray(even))
    finally:
        if encoder is not None:
            encoder.close()
