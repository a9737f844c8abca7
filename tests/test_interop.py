"""Neighbours: the arrays of a state are memory that NumPy, PyTorch and JAX share, and what a missing one is told of."""

import importlib
import sys

import numpy as np
import pytest
import warp as wp

import warpfem as wf

MESH = wf.Mesh.box(size=(1.0, 1.0, 1.0), cells=(1, 1, 1))


@pytest.fixture(params=["float32", "float64"])
def state(request):
    scene = wf.Scene([wf.Body("block", MESH, wf.StableNeoHookean(E=1e5, nu=0.3))], wf.BackwardEuler())
    return wf.Model(scene, device="cpu", dtype=request.param).state()


def test_numpy_shares(state):
    view = state.u.numpy()
    assert view.shape == (MESH.point_count, 3)
    view[2] = (1.0, 2.0, 3.0)
    assert state.displacement[2].tolist() == [1.0, 2.0, 3.0]


def test_pytorch_shares(state):
    torch = pytest.importorskip("torch")
    tensor = wp.to_torch(state.u)
    assert tuple(tensor.shape) == (MESH.point_count, 3) and tensor.data_ptr() == state.u.ptr
    tensor[1, 1] = 2.0
    assert state.displacement[1].tolist() == [0.0, 2.0, 0.0]
    state.v.fill_(7.0)
    assert bool((wp.to_torch(state.v) == 7.0).all())
    theirs = torch.ones_like(tensor)
    ours = wp.from_torch(theirs, dtype=state.u.dtype)
    ours.fill_(3.0)
    assert float(theirs.sum()) == 9.0 * MESH.point_count


def test_jax_shares(state):
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    before = np.arange(3.0 * MESH.point_count).reshape(-1, 3)
    state.assign(displacement=before)
    array = wp.to_jax(state.u)
    assert array.unsafe_buffer_pointer() == state.u.ptr
    assert float(jax.numpy.abs(array - before).max()) == 0.0
    view = wp.from_jax(array, dtype=state.u.dtype)
    assert view.ptr == state.u.ptr and view.dtype == state.u.dtype
    state.u.fill_(5.0)
    assert np.asarray(wp.to_jax(state.u)).tolist() == [[5.0, 5.0, 5.0]] * MESH.point_count


def test_a_missing_newton_is_named_with_its_extra(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("warpfem.interop.newton")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "newton", None)
    with pytest.raises(wf.MissingExtraError, match=r"'newton': pip install 'warpfem\[newton\]'"):
        importlib.import_module("warpfem.interop.newton")
