"""Frames are stored in a thread: in order, completely, and what goes wrong is told."""

import threading

import numpy as np
import pytest
from test_usd import make_body, make_frame

import warpfem as wf
from warpfem.errors import OutputError
from warpfem.record import body_frames
from warpfem.usd import BackgroundWriter, UsdWriter, partial_path, read_animation


def test_the_file_is_that_of_the_writer_alone(tmp_path):
    body = make_body(3)
    with UsdWriter(tmp_path / "alone.usdc", [body], fps=24.0) as alone:
        for index in range(20):
            alone.write_frame([make_frame(body, index)])
    with BackgroundWriter(UsdWriter(tmp_path / "run.usdc", [body], fps=24.0)) as writer:
        for index in range(20):
            writer.write_frame([make_frame(body, index)])
    assert (tmp_path / "run.usdc").read_bytes() == (tmp_path / "alone.usdc").read_bytes()


class Slow:
    """A writer that stores a frame only when it is told to."""

    def __init__(self) -> None:
        self.stored: list[int] = []
        self.may_go_on = threading.Semaphore(0)

    def write_frame(self, frames: list[int]) -> None:
        assert self.may_go_on.acquire(timeout=60.0)
        self.stored += frames

    def flush(self) -> None:
        self.stored.append(-1)

    def __exit__(self, *exception: object) -> None:
        self.stored.append(-2)


def test_the_caller_goes_on_with_one_frame_on_its_way():
    slow = Slow()
    with BackgroundWriter(slow) as writer:
        writer.write_frame([0])  # would wait for ever if it waited for its own frame
        assert slow.stored == []
        slow.may_go_on.release()
        writer.write_frame([1])
        assert slow.stored == [0]
        slow.may_go_on.release()
        writer.flush()
        assert slow.stored == [0, 1, -1]
        writer.write_frame([2])
        slow.may_go_on.release()
    assert slow.stored == [0, 1, -1, 2, -2]


@pytest.mark.parametrize("how", ["by the next frame", "by a flush", "at the end", "beside another error"])
def test_a_frame_that_cannot_be_stored_is_told(tmp_path, how):
    body = make_body(3)
    bad = make_frame(body, 3)
    bad.points[1] = np.nan
    error = ZeroDivisionError if how == "beside another error" else OutputError
    with pytest.raises(error) as raised, BackgroundWriter(UsdWriter(tmp_path / "run.usdc", [body], fps=24.0)) as writer:
        for index in range(3):
            writer.write_frame([make_frame(body, index)])
        writer.write_frame([bad])
        if how == "by the next frame":
            writer.write_frame([make_frame(body, 4)])
        elif how == "by a flush":
            writer.flush()
        elif how == "beside another error":
            raise ZeroDivisionError("something else")
    text = "\n".join([str(raised.value), *getattr(raised.value, "__notes__", [])])
    assert "frame 3" in text and "not finite" in text
    assert read_animation(tmp_path / "run.usdc").frame_count == 3
    assert not partial_path(tmp_path / "run.usdc").exists()


def test_what_the_caller_does_with_a_frame_does_not_reach_the_file():
    body = wf.Body("cube", wf.Mesh.box((1, 1, 1), (1, 1, 1)), wf.StableNeoHookean(E=1e5, nu=0.3), density=1000)
    simulation = wf.Simulation(wf.Scene([body], wf.BackwardEuler(), frames=0))
    (frame,) = simulation.frames()
    (stored,) = body_frames(simulation.model, frame)
    kept = [array.copy() for array in vars(stored).values()]
    for array in (frame.displacement, frame.velocity, frame.jacobian, frame.von_mises):
        array += 1.0
    for array, before in zip(vars(stored).values(), kept, strict=True):
        np.testing.assert_array_equal(array, before)
