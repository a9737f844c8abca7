"""What commands leave behind: asking before it is replaced, and saying where it is."""

from __future__ import annotations

import sys
from pathlib import Path

from warpfem.checkpoint import checkpoint_path
from warpfem.errors import OutputError


def require_consent(out: Path, log: Path | None = None) -> None:
    """Asks before what an earlier run left is replaced; refuses where nobody can be asked.

    Raises:
        OutputError: it is to stay.
    """
    from warpfem.usd import partial_path

    partial = partial_path(out)
    found = [f"{path} exists" for path in (out, log) if path is not None and path.exists()]
    if partial.exists():
        found.append(f"{_frames_in(partial)} in {partial}, of a run that was killed")
    if not found:
        return
    text = ", and ".join(found)
    if checkpoint_path(out).exists():
        text += f" (to go on from {checkpoint_path(out)}, use --resume)"
    if sys.stdin.isatty() and sys.stderr.isatty():
        print(f"{text}: overwrite? [y/N] ", end="", file=sys.stderr, flush=True)
        if sys.stdin.readline().strip().lower() in ("y", "yes"):
            return
        raise OutputError("nothing was run, and nothing overwritten")
    other = "--log" if found == [f"{log} exists"] else "--out"
    raise OutputError(f"{text}: use --overwrite to replace it, or another {other}")


def kept(out: Path) -> str:
    """Says where the frames of a run that has ended early are."""
    from warpfem.usd import partial_path

    for path in (partial_path(out), out):
        if path.exists():
            return f"{_frames_in(path)} in {path}"
    return "no frame is left"


def _frames_in(path: Path) -> str:
    from warpfem.usd import frames_over, read_animation

    try:
        count = read_animation(path).frame_count
    except OutputError:
        try:
            count = frames_over(path)
        except OutputError:
            return "no readable frames are"
    return "1 frame is" if count == 1 else f"{count} frames are"


def make_writable(out: Path) -> None:
    """Finds out that a text file cannot be written before the work of hours is lost."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.open("a").close()
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from None
