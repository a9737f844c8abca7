"""From a stage to a file: a sheet of frames, or a film."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from warpfem.errors import MissingExtraError, OutputError
from warpfem.files import replacing
from warpfem.preview.camera import parse_camera
from warpfem.preview.coloring import Coloring
from warpfem.preview.film import Film, require_encoder, write_gif, write_mp4
from warpfem.preview.page import Page
from warpfem.preview.scene import Scene
from warpfem.usd import read_pictured_stage

MOST_FRAMES = {".png": 6, ".gif": 120, ".mp4": 480}
"""Frames in a preview, unless another number is asked for."""


def preview(
    path: str | Path,
    out: str | Path,
    *,
    frames: int | None = None,
    camera: str | None = None,
    color: str | None = None,
) -> Path:
    """Draws the motion in a USD file, of warpfem or of others.

    One camera without perspective fits the whole motion and what obstacles are near it. It looks straight at 2D
    scenes; at 3D ones from the front, above and the right, or from the left if planes lean to that side, unless
    it is told otherwise. Colours are shaded in 3D; parts of a body that are inside out are magenta. The tiles of a
    plane are as wide as the scale bar is long, a body's shadow lies straight below it, and planes that are seen
    from behind are glass.

    Args:
        path: what a run or a static solve wrote, finished or partial, or any stage with meshes whose points move: of
            such a stage meshes, planes, cubes and spheres are drawn.
        out: the file to write. ``.png``: a sheet of evenly spaced frames, first and last included. ``.gif`` and
            ``.mp4``: the motion in real time, without the frames that would be too many or too short; runs of less
            than a second are slowed down to 25 frames per second.
        frames: the most frames to draw; ``None`` for those of ``MOST_FRAMES``.
        camera: one of ``CAMERAS``, or azimuth and elevation such as ``"30,20"`` [degrees]; 3D only.
        color: what the colours show: a scalar primvar of the file such as ``"J"``, per cell or per point, or
            ``"displacement"`` or ``"speed"``, with the range that it has in all frames. ``None``: what the colours of a
            file of warpfem show, with their range, and the displacement in others.

    Returns:
        The path of the picture.

    Raises:
        OutputError: ``out`` has another suffix or cannot be written, ``frames`` is below 1, ``camera`` or ``color``
            is unknown, or ``path`` is missing, not USD, or has nothing that moves.
        MissingExtraError: Matplotlib or Pillow is not installed, or imageio-ffmpeg for ``.mp4``.
    """
    if not isinstance(out, str | os.PathLike):
        raise OutputError(f"the name of a preview must be a str or a path, not {out!r}")
    out = Path(out)
    _check_settings(out, frames)
    direction = None if camera is None else parse_camera(camera)
    try:
        import matplotlib.figure  # noqa: F401
        import PIL.Image  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("drawing a preview", error.name or "matplotlib", "plot") from error
    if out.suffix == ".mp4":
        require_encoder()
    stage = read_pictured_stage(path)
    if not stage.frame_count:
        raise OutputError(f"{path} has no frames to draw: the run ended before the first one was saved")

    coloring = Coloring.of(stage, color)
    scene = Scene(coloring, direction)
    most = frames or MOST_FRAMES[out.suffix]
    try:
        with replacing(out) as temporary:
            if out.suffix == ".png":
                _write_sheet(temporary, coloring, scene, most)
            elif out.suffix == ".gif":
                write_gif(temporary, Film(coloring, scene, most, shortest=0.02))
            else:
                write_mp4(temporary, Film(coloring, scene, most, shortest=1 / 60))
    except OSError as error:
        raise OutputError(f"{out} cannot be written: {error}") from error
    return out


def _check_settings(out: Path, frames: int | None) -> None:
    if out.suffix not in MOST_FRAMES:
        raise OutputError(f"{out}: the name of a preview must end in {', '.join(MOST_FRAMES)}")
    if os.path.isdir(out):
        raise OutputError(f"{out} is a folder: give the name of a file")
    if not os.access(out if os.path.exists(out) else out.parent, os.W_OK):
        raise OutputError(f"{out} cannot be written: its folder does not exist, or writing is not permitted")
    if frames is not None and (isinstance(frames, bool) or not isinstance(frames, int) or frames < 1):
        raise OutputError(f"{out}: a preview has at least 1 frame, not {frames!r}")


def _write_sheet(path: Path, coloring: Coloring, scene: Scene, most: int) -> None:
    frame_count = coloring.stage.frame_count
    chosen = np.linspace(0, frame_count - 1, min(most, frame_count)).round().astype(int).tolist()
    page = Page(coloring, scene.view, len(chosen))
    page.show([scene.image(index) for index in chosen], chosen)
    page.figure.savefig(path, format="png")
