"""Launches that are kept, and numbers that kernels add to."""

import numpy as np
import warp as wp

from warpfem import launches
from warpfem.launches import Launcher, Total
from warpfem.points import chunks, point_kernels
from warpfem.profiling import observe_launches
from warpfem.solvers.incremental_potential import _kernels

ADD_SCALED = _kernels(3, "float32").add_scaled


def vectors(*rows: float) -> wp.array:
    return wp.array(np.repeat(np.array(rows, dtype=np.float32), 3).reshape(-1, 3), dtype=wp.vec3f, device="cpu")


def test_what_is_kept_takes_the_numbers_of_each_launch():
    launch, a, b, out = Launcher("cpu"), vectors(1, 2), vectors(10, 20), vectors(0, 0)
    for factor in (1.0, -2.0, -2.0, 1.0):
        launch(ADD_SCALED, 2, [a, factor, b], [out])
        np.testing.assert_array_equal(out.numpy()[:, 0], [1 + factor * 10, 2 + factor * 20])


def test_other_arrays_and_counts_are_other_launches():
    launch, a, b = Launcher("cpu"), vectors(1, 2), vectors(10, 20)
    whole, part = vectors(0, 0), vectors(0, 0)
    launch(ADD_SCALED, 2, [a, 1.0, b], [whole])
    launch(ADD_SCALED, 1, [a, 1.0, b], [part])
    launch(ADD_SCALED, 0, [a, 1.0, b], [part])
    np.testing.assert_array_equal(whole.numpy()[:, 0], [11, 22])
    np.testing.assert_array_equal(part.numpy()[:, 0], [11, 0])
    launch(ADD_SCALED, 1, [a[1:], 1.0, b], [part])
    assert part.numpy()[0, 0] == 12


def test_arrays_that_come_and_go_are_not_taken_for_each_other(monkeypatch):
    """Memory that is freed is soon used again; what is kept is let go in the end."""
    monkeypatch.setattr(launches, "MOST_KEPT", 4)
    launch, b = Launcher("cpu"), vectors(10, 20)
    for value in range(20):
        out = vectors(0, 0)
        launch(ADD_SCALED, 2, [vectors(value, value), 1.0, b], [out])
        np.testing.assert_array_equal(out.numpy()[:, 0], [value + 10, value + 20])
        assert len(launch._kept) <= 4


def test_a_graph_and_an_observer_see_what_is_kept():
    launch, a, b, out = Launcher("cpu"), vectors(1, 2), vectors(10, 20), vectors(0, 0)
    launch(ADD_SCALED, 2, [a, 1.0, b], [out])
    with wp.ScopedCapture(device="cpu") as capture:
        launch(ADD_SCALED, 2, [a, 1.0, b], [out])
    a.assign(vectors(3, 4))
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(out.numpy()[:, 0], [13, 24])
    with observe_launches("cpu") as seen:
        launch(ADD_SCALED, 2, [a, 1.0, b], [out])
    assert seen.names == {"add_scaled"}


def test_a_total_is_what_kernels_have_added_since_it_was_cleared():
    total, a = Total("cpu"), vectors(1, 2)
    for _ in range(2):
        total.clear()
        wp.launch(point_kernels(3, "float32").dot, chunks(2), inputs=[a, a], outputs=[total.array], device="cpu")
        assert total.read() == 15.0
