"""Kernels compile for GPUs on a machine without one, and what their launches cost is counted right."""

import sys

import gpu
import numpy as np
import pytest
import warp as wp
from launches import Launch, launches_of

import warpfem as wf

compiles = pytest.mark.skipif(sys.platform == "darwin", reason="Warp has no CUDA compiler there")


def cube() -> wf.Scene:
    body = wf.Body("cube", wf.Mesh.box((1, 1, 1), (1, 1, 1)), wf.StableNeoHookean(E=1e5, nu=0.3), density=1000)
    return wf.Scene([body], wf.SymplecticEuler(), dt=1e-4)


@compiles
@pytest.mark.parametrize("architecture", gpu.ARCHITECTURES)
def test_the_force_compiles(tmp_path, architecture):
    kernel = wf.Model(cube()).blocks[0].kernels.force
    ptx = gpu.compile_module(kernel.module, architecture, tmp_path)
    assert f".target sm_{architecture}" in ptx
    operations = gpu.flops(ptx, gpu.entry_name(kernel))
    # H = sum of 3 outer products 27 fma; P about 100; 3 products with gradients 27 fma
    assert 150 < operations["f32"] < 600
    assert operations["f64"] == 0


@compiles
@pytest.mark.slow
def test_the_kernels_of_the_shipped_scenes_compile(tmp_path):
    modules = {kernel.module for kernel in gpu.shipped_kernels()}
    assert len(modules) > 30
    for module in modules:
        for architecture in gpu.ARCHITECTURES:
            assert f".target sm_{architecture}" in gpu.compile_module(module, architecture, tmp_path)


def test_flops_are_those_of_the_kernel_alone():
    ptx = """
.visible .entry first(
	fma.rn.f32 %f1, %f2, %f3, %f4;
}
.visible .entry second(
	mul.f32 %f1, %f2, %f3;
	@%p1 fma.rn.f32 %f1, %f2, %f3, %f4;
	div.rn.f32 %f1, %f2, %f3;
	add.f64 %fd1, %fd2, %fd3;
	add.s32 %r1, %r2, %r3;
	ld.global.f32 %f1, [%rd1];
}
"""
    assert gpu.flops(ptx, "second") == {"f32": 11, "f64": 1}


def test_launches_are_counted_with_their_bytes():
    model = wf.Model(cube())
    u, force = model.zeros(), model.zeros()
    launches = launches_of(lambda: [model.force(u, force), force.numpy()])
    points, cells, scalar = 8, 5, 4
    kernel = model.blocks[0].kernels.force
    cell_bytes = 4 * 4 + 9 * scalar + scalar  # points, B and volume; the parameters are one entry for all
    size = cells * cell_bytes + 2 * scalar + points * 3 * scalar * (1 + 2)  # force_out is added to
    assert launches.counts == {Launch(None, points, points * 3 * scalar): 1, Launch(kernel, cells, size): 1}
    assert launches.reads == 1
    assert launches.kernels() == [kernel]


def test_recorded_commands_count_when_they_run():
    model = wf.Model(cube())
    a = model.zeros()
    kernel = wf.Model(cube()).blocks[0].kernels.density
    arguments = model.blocks[0].arguments
    out = wp.zeros(5, dtype=wp.float32)

    def work() -> None:
        inputs = [arguments["cells"], arguments["inverse_shape"], arguments["parameters"], a]
        command = wp.launch(kernel, 5, inputs=inputs, outputs=[out], record_cmd=True)
        for _ in range(3):
            command.launch()

    assert launches_of(work).counts.total() == 3


def test_predicted_times_are_the_longer_of_memory_and_arithmetic():
    card = gpu.Gpu("a card", bandwidth=1e12, float32=1e13, float64=1e12, source="")
    memory = gpu.Work(bytes=80.0, float32=100.0, float64=0.0, launches=1, reads=0)
    arithmetic = gpu.Work(bytes=8.0, float32=1000.0, float64=100.0, launches=1, reads=0)
    assert memory.seconds(card, 1e6) == pytest.approx(1e-4)
    assert arithmetic.seconds(card, 1e6) == pytest.approx(2e-4)


def test_registers_are_read_from_the_assembler(tmp_path):
    assembler = tmp_path / "ptxas"
    assembler.write_text(
        "#!/bin/sh\n"
        "cat >&2 <<'END'\n"
        "ptxas info    : Compiling entry function 'force' for 'sm_80'\n"
        "ptxas info    : Function properties for force\n"
        "    48 bytes stack frame, 16 bytes spill stores, 12 bytes spill loads\n"
        "ptxas info    : Used 72 registers, used 0 barriers\n"
        "END\n"
    )
    assembler.chmod(0o755)
    found = gpu.resources(str(assembler), "", 80)
    assert found == {"force": gpu.Resources(registers=72, stack=48, spill_stores=16, spill_loads=12)}
    assert found["force"].warps == 24  # 3 blocks of 256 threads: 65536 / (72 * 256)
    assert np.all([gpu.Resources(r, 0, 0, 0).warps == w for r, w in ((32, 64), (33, 48), (255, 8))])
