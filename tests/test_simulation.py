"""The frame loop, its summary, and what a scene does not require."""

import subprocess
import sys

import numpy as np
import pytest

import warpfem as wf
from warpfem.explain import explain
from warpfem.model import device_bytes


def cube(**settings) -> wf.Scene:
    body = {key: settings.pop(key) for key in ("supports", "loads", "displacement") if key in settings}
    mesh = wf.Mesh.box((1, 1, 1), (1, 1, 1))
    material = settings.pop("material", wf.StableNeoHookean(E=1e5, nu=0.3))
    settings.setdefault("solver", wf.BackwardEuler())
    return wf.Scene([wf.Body("cube", mesh, material, **body)], **settings)


def test_frames_are_at_multiples_of_the_interval():
    simulation = wf.Simulation(cube(gravity=(0, -10, 0), dt=0.03, fps=10, frames=4))
    frames = list(simulation.frames())
    assert simulation.steps_per_frame == 4
    assert simulation.dt == pytest.approx(0.025)
    np.testing.assert_allclose([frame.time for frame in frames], [0.0, 0.1, 0.2, 0.3, 0.4])
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    assert simulation.summary.steps == 16
    assert simulation.summary.frames == 5
    n = 16  # free fall by backward Euler: u = g dt^2 n (n + 1) / 2
    np.testing.assert_allclose(frames[-1].displacement[:, 1], -10 * 0.025**2 * n * (n + 1) / 2, rtol=1e-5)


def test_zero_frames_give_the_initial_state():
    simulation = wf.Simulation(cube(frames=0, displacement=(0.5, 0, 0)))
    (frame,) = simulation.frames()
    np.testing.assert_array_equal(frame.displacement[:, 0], 0.5)
    assert simulation.summary.steps == 0


@pytest.mark.parametrize("dt", [1e-3, 1 / 24])
def test_a_dt_that_divides_the_interval_is_kept(dt):
    assert wf.Simulation(cube(dt=dt, fps=1 / (dt * round(1 / 24 / dt)), frames=1)).dt == pytest.approx(dt)


def test_auto_dt_is_a_part_of_the_limit_for_explicit_steps_and_the_interval_for_implicit_ones():
    explicit = wf.Simulation(cube(solver=wf.VelocityVerlet(), frames=1))
    assert explicit.dt <= 0.6 * explicit.stepper.stable_dt() < 1.5 * explicit.dt
    assert wf.Simulation(cube(frames=1)).dt == pytest.approx(1 / 24)


@pytest.mark.parametrize(
    ("material", "message"),
    [
        (wf.StVenantKirchhoff, "StVenantKirchhoff does not turn them back"),
        (wf.StableNeoHookean, "the body may come to rest folded"),
    ],
)
def test_inverted_cells_are_warned_of_once(material, message):
    mirrored = cube(frames=1, material=material(1e5, 0.3), displacement=lambda x: -2.0 * x * (1.0, 0.0, 0.0))
    with pytest.warns(UserWarning, match="inverted") as warned:
        for _ in wf.Simulation(mirrored, device="cpu").frames():
            pass
    (text,) = (str(warning.message) for warning in warned)
    assert text.startswith("t = 0 s: 5 of 5 cells of body 'cube' are inverted (the first is cell 0, J = -1)")
    assert message in text


def test_no_warning_without_inverted_cells_or_where_they_do_no_harm(recwarn):
    wf.Simulation(cube(frames=0, displacement=lambda x: -0.9 * x), device="cpu")
    linear = wf.LinearElasticity(1e5, 0.3)
    wf.Simulation(cube(frames=0, material=linear, displacement=lambda x: -2.0 * x * (1.0, 0.0, 0.0)), device="cpu")
    assert not recwarn.list


def test_the_step_thrown_away_leaves_no_trace():
    scene = cube(gravity=(0, -10, 0), dt=1 / 24, frames=1)
    simulation = wf.Simulation(scene)
    first, _ = simulation.frames()
    np.testing.assert_array_equal(first.displacement, 0.0)
    np.testing.assert_array_equal(first.velocity, 0.0)
    assert simulation.state.time == pytest.approx(1 / 24)


def test_a_simulation_runs_once():
    simulation = wf.Simulation(cube(frames=1))
    list(simulation.frames())
    with pytest.raises(wf.SimulationError, match="has been run"):
        next(simulation.frames())


def test_a_fall_has_all_its_kernels_before_it_starts():
    from warpfem.profiling import observe_launches

    scene = cube(gravity=(0, -10, 0), dt=0.02, frames=24, obstacles=[wf.Plane((0, -0.2, 0), (0, 1, 0), friction=0.3)])
    with observe_launches() as before:
        simulation = wf.Simulation(scene)
    with observe_launches() as during:
        list(simulation.frames())
    modules = {use.module for use in during.kernels.values()}
    assert modules <= {use.module for use in before.kernels.values()}
    assert "contact_blocks" in during.names  # it did land


def test_a_step_that_rounding_hides_is_counted_and_a_useless_one_is_not_called_converged():
    def shifted(distance):
        pinned = cube(
            gravity=(0, -10, 0),
            displacement=(distance, 0, 0),
            dt=1 / 24,
            frames=2,
            solver=wf.BackwardEuler(tolerance=1e-6),
        )
        simulation = wf.Simulation(pinned)
        mesh = pinned.bodies[0].mesh
        simulation.state.assign(displacement=simulation.state.displacement + 0.05 * mesh.points * (0, 1, 0))
        list(simulation.frames())
        return simulation.summary

    near, far = shifted(0.0), shifted(1e5)
    assert near.unconverged_steps == 0
    assert far.unconverged_steps > 0
    assert "rounding of float32" in far.worst_note
    assert far.worst_residual > 1e-2


def test_auto_dt_minds_the_first_state():
    squashed = cube(
        material=wf.NeoHookean(E=1e5, nu=0.3),
        displacement=lambda x: x * (0, -0.75, 0),
        solver=wf.VelocityVerlet(),
        frames=1,
    )
    simulation = wf.Simulation(squashed)
    assert simulation.dt < 0.5 * simulation.stepper.stable_dt()


@pytest.mark.filterwarnings("ignore:.*inverted")
def test_summary_counts_unconverged_steps():
    hard = cube(
        supports=[wf.Pin("bottom")],
        loads=[wf.Traction("top", (0, -2e5, 0))],
        solver=wf.BackwardEuler(max_iterations=2, tolerance=1e-9, unconverged="accept"),
        frames=2,
    )
    simulation = wf.Simulation(hard, dtype="float64")
    list(simulation.frames())
    assert simulation.summary.unconverged_steps == 2
    assert simulation.summary.worst_residual > 1e-9
    assert "2 Newton iterations" in simulation.summary.worst_note


def test_a_run_that_breaks_down_names_time_body_and_cell():
    # Neo-Hookean, explicit, squashed through itself
    def squash(rest, time):
        return rest * (1.0, 1.0 - 40.0 * time, 1.0)

    scene = cube(
        material=wf.NeoHookean(E=1e5, nu=0.3),
        supports=[wf.Pin("bottom"), wf.PrescribedMotion("top", squash)],
        solver=wf.VelocityVerlet(),
        dt=1e-3,
        frames=4,
    )
    simulation = wf.Simulation(scene)
    good = []
    with pytest.raises(wf.SimulationError, match=r"t = 0\.0\d+ s: .* of body 'cube'"):
        for frame in simulation.frames():
            good.append(frame)
    assert len(good) >= 1
    assert all(np.isfinite(frame.displacement).all() for frame in good)


TERMS = {
    "contact": dict(obstacles=[wf.Plane((0, -1, 0), (0, 1, 0))]),
    "friction": dict(obstacles=[wf.Plane((0, -1, 0), (0, 1, 0), friction=0.5)]),
    "supports": dict(supports=[wf.Pin("bottom")]),
    "gravity": dict(gravity=(0, -9.81, 0)),
    "loads": dict(loads=[wf.PointForce("top", (1, 0, 0))]),
    "damping": dict(damping=1.0),
}


@pytest.mark.parametrize("term", TERMS)
def test_explain_reports_the_term_that_is_on(term):
    explanation = explain(cube(frames=1, **TERMS[term]))
    on = {t.name for t in explanation.terms if t.on}
    assert on == {"elasticity", term} | ({"contact"} if term == "friction" else set())


def test_a_term_that_is_off_costs_nothing():
    bare = wf.Simulation(cube(frames=1, displacement=lambda x: 0.01 * x))
    explanation = explain(bare.scene)
    names = {use.name for use in explanation.kernels + explanation.other_kernels}
    modules = {use.module for use in explanation.kernels + explanation.other_kernels}
    assert bare.model.contact is None and bare.model.supports is None and bare.model.dead_load is None
    assert not [module for module in modules if "contact" in module or "supports" in module]
    for term, settings in TERMS.items():
        richer = explain(cube(frames=1, displacement=lambda x: 0.01 * x, **settings))
        assert names <= {use.name for use in richer.kernels + richer.other_kernels}
        more = richer.model_bytes + richer.solver_bytes
        less = explanation.model_bytes + explanation.solver_bytes
        assert more == less if term == "damping" else more > less  # damping is a number


def test_what_a_scene_lacks_is_not_imported():
    code = """
import sys, warp as wp
wp.config.log_level = wp.LOG_ERROR
import warpfem as wf
body = wf.Body("a", wf.Mesh.box((1, 1, 1), (1, 1, 1)), wf.LinearElasticity(E=1e5, nu=0.3))
simulation = wf.Simulation(wf.Scene([body], wf.BackwardEuler(), frames=1), device="cpu")
list(simulation.frames())
heavy = {"pxr", "matplotlib", "meshio", "pytetwild", "tqdm", "warpfem.contact", "warpfem.supports", "warpfem.usd"}
print(sorted(heavy & set(sys.modules)))
"""
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed.strip().splitlines()[-1] == "[]"


def test_device_bytes_count_a_uniform_array_once():
    scene = cube(frames=1)
    model = wf.Model(scene)
    parameters = model.blocks[0].arguments["parameters"]
    assert parameters.shape == (5,)
    assert device_bytes([parameters]) == 2 * 4
    assert device_bytes([model.mass]) == 8 * 4


@pytest.mark.filterwarnings("ignore:.*inverted")
def test_a_body_without_volume_is_no_failure_for_a_material_that_bears_inversion():
    flat = cube(displacement=lambda x: -x * (0, 1, 0), dt=1e-3, fps=20, frames=4)
    frames = list(wf.Simulation(flat).frames())
    assert frames[0].jacobian == pytest.approx(0.0)
    assert np.isfinite(frames[0].von_mises).all()


def test_functions_of_the_user_get_copies_and_their_errors_are_named():
    def shove(points):
        points[:, 0] += 1.0
        return points

    scene = cube(displacement=shove)
    np.testing.assert_array_equal(scene.bodies[0].initial_displacement()[:, 0], scene.bodies[0].mesh.points[:, 0] + 1.0)
    with pytest.raises(wf.SceneError, match=r"body 'cube', initial displacement: ZeroDivisionError: .*line \d+"):
        wf.Model(cube(displacement=lambda points: 1 / 0)).state()


def test_only_a_scene_makes_a_model():
    with pytest.raises(wf.SceneError, match=r"a model is made of a warpfem.Scene, not of \[1\]"):
        wf.Simulation([1])


@pytest.mark.parametrize(
    ("material", "nu"), [(wf.NeoHookean, -0.1), (wf.FixedCorotated, -0.1), (wf.StableNeoHookean, -0.9)]
)
def test_poissons_ratios_whose_energy_is_not_least_at_rest_are_pointed_out(material, nu):
    with pytest.warns(UserWarning, match=f"{material.__name__}: for nu < "):
        material(E=1.0, nu=nu)


def test_run_returns_the_summary_and_writes_the_file(tmp_path):
    out = tmp_path / "cube.usdc"
    summary = wf.run(cube(frames=2, gravity=(0, -10, 0)), out, device="cpu")
    assert summary.frames == 3
    assert summary.last_energies.kinetic > 0.0
    assert out.is_file()


def test_steel_falls_in_float32_though_its_noise_hides_gravity():
    block = wf.Mesh.rectangle((1.0, 1.0), (4, 4), (0.0, 0.3))
    steel = wf.Body("steel", block, wf.StableNeoHookean(E=2e11, nu=0.3), density=7800.0)
    floor = wf.Plane((0.0, 0.0), (0.0, 1.0))
    scene = wf.Scene([steel], wf.BackwardEuler(), gravity=(0.0, -9.81), obstacles=[floor], frames=24)
    frames = list(wf.Simulation(scene, device="cpu").frames())
    fallen = [frame.displacement[:, 1].mean() for frame in frames]
    steps = np.arange(5)
    np.testing.assert_allclose(fallen[:5], -9.81 * steps * (steps + 1) / 2 / 24**2, rtol=1e-4)  # backward Euler's
    assert fallen[-1] == pytest.approx(-0.3, abs=1e-4)


def test_frames_of_too_many_steps_are_refused():
    speck = wf.Body("speck", wf.Mesh.rectangle((4e-9, 4e-9), (2, 2)), wf.StableNeoHookean(E=1e9, nu=0.3))
    with pytest.raises(wf.errors.SceneError, match=r"a frame of 0.0417 s would take .* steps of .* s: raise fps"):
        wf.Simulation(wf.Scene([speck], wf.VelocityVerlet()), device="cpu", dtype="float64")
