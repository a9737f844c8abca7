"""Stages as scenes, and layers over them: units, axes and transforms, what is warned of, what is refused."""

from __future__ import annotations

import os
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom
from test_usd import validation_errors

import warpfem as wf
from warpfem.cli import main
from warpfem.commands.output import kept
from warpfem.embedding import Embedding
from warpfem.trade.problem import Problem, Setting
from warpfem.usd import BodyFrame, OverWriter, partial_path
from warpfem.usd.physics.reader import stage_scene
from warpfem.usd.pictured import read_pictured_stage


@pytest.fixture
def child_process() -> None:
    """Asked for by tests that read in a child process, as users do; it takes a second."""


@pytest.fixture(autouse=True)
def in_process(request, monkeypatch) -> None:
    if "child_process" not in request.fixturenames:
        for module in ("warpfem.usd", "warpfem.usd.over"):
            monkeypatch.setattr(f"{module}.read_stage_scene", lambda path: stage_scene(str(path)))


CUBE = wf.Mesh.box((1, 1, 1), (1, 1, 1))
GRAVITY = 9.81

MATERIAL = """
def Material "Rubber" (prepend apiSchemas = ["PhysicsMaterialAPI", "PhysicsVolumeDeformableMaterialAPI"])
{
    float physics:youngsModulus = 1e5
    float physics:poissonsRatio = 0.4
    float physics:density = 1000
}
"""
HEAD = 'upAxis = "Y"\n    metersPerUnit = 1'
SIMULATION = "PhysicsVolumeDeformableSimAPI"


def vectors(rows: np.ndarray) -> str:
    return "[" + ", ".join(f"({', '.join(repr(float(x)) for x in row)})" for row in np.asarray(rows)) + "]"


def indices(rows: np.ndarray) -> str:
    return "[" + ", ".join(str(tuple(int(i) for i in row)) for row in rows) + "]"


def tets(name: str = "sim", mesh: wf.Mesh = CUBE, apis: str = f'"{SIMULATION}", "PhysicsCollisionAPI"', more: str = ""):
    return f"""
def TetMesh "{name}" (prepend apiSchemas = [{apis}, "MaterialBindingAPI"])
{{
    point3f[] points = {vectors(mesh.points)}
    int4[] tetVertexIndices = {indices(mesh.cells)}
    rel material:binding:physics = </Rubber>
    {more}
}}
"""


SCENE = 'def PhysicsScene "Scene" {}'


def write(path: Path, *prims: str, head: str = HEAD) -> Path:
    path.write_text(f"#usda 1.0\n(\n    {head}\n)\n" + "\n".join(prims))
    return path


def read(path: Path) -> wf.Scene:
    """The scene of a stage of which nothing is warned."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return wf.read_stage(path)


def remarks(path: Path) -> list[str]:
    """What is warned of in a stage, without the name of the file."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        wf.read_stage(path)
    assert all(str(each.message).startswith(str(path)) for each in caught)
    return [str(each.message).removeprefix(f"{path}, ").removeprefix(f"{path}: ") for each in caught]


def points_at(path: Path, prim: str, code: float | None = None) -> np.ndarray:
    stage = Usd.Stage.Open(str(path))
    attribute = stage.GetAttributeAtPath(f"{prim}.points")
    return np.array(attribute.Get() if code is None else attribute.Get(code), float)


# ---- a stage is a scene


def test_a_stage_becomes_a_scene(tmp_path: Path) -> None:
    path = write(
        tmp_path / "stage.usda",
        SCENE,
        tets(more=f"vector3f[] velocities = {vectors(np.tile([1.0, 2.0, 3.0], (8, 1)))}"),
        MATERIAL,
        head=HEAD
        + "\n    startTimeCode = 10\n    endTimeCode = 34\n    timeCodesPerSecond = 48\n    framesPerSecond = 24",
    )
    scene = read(path)
    (body,) = scene.bodies
    assert body.name == "sim"
    np.testing.assert_array_equal(body.mesh.points, CUBE.points)
    np.testing.assert_array_equal(body.mesh.cells, CUBE.cells)
    assert isinstance(body.material, wf.StableNeoHookean)
    assert (body.material.E, body.material.nu, body.density) == (1e5, 0.4, 1000.0)
    np.testing.assert_array_equal(body.initial_velocity(), np.tile([1.0, 2.0, 3.0], (8, 1)))
    assert body.displacement is None and not body.supports
    assert scene.gravity == (0.0, -GRAVITY, 0.0)
    assert (scene.fps, scene.frames, scene.up_axis) == (24.0, 12, "Y")
    assert isinstance(scene.solver, wf.BackwardEuler)


NESTED = """
def Xform "World"
{{
    double3 xformOp:translate = (100, 0, 0)
    float3 xformOp:rotateXYZ = (0, 0, 90)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]

    def Xform "Group"
    {{
        double3 xformOp:translate = (0, 50, 200)
        double3 xformOp:scale = (100, 100, -100)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
        {body}
    }}
    def Plane "Ground" (prepend apiSchemas = ["PhysicsCollisionAPI", "MaterialBindingAPI"])
    {{
        rel material:binding:physics = </Slippery>
        float3 xformOp:rotateXYZ = (0, 20, 0)
        uniform token[] xformOpOrder = ["xformOp:rotateXYZ"]
    }}
    def Sphere "Ball" (prepend apiSchemas = ["PhysicsCollisionAPI"])
    {{
        double radius = 30
        double3 xformOp:translate = (0, 0, -40)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def Cube "Step" (prepend apiSchemas = ["PhysicsCollisionAPI"])
    {{
        double3 xformOp:translate = (10, 20, -30)
        float3 xformOp:rotateXYZ = (0, 0, 30)
        float3 xformOp:scale = (5, 10, 15)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]
    }}
}}
def Material "Slippery" (prepend apiSchemas = ["PhysicsMaterialAPI"])
{{
    float physics:dynamicFriction = 0.25
}}
def PhysicsScene "Scene"
{{
    float physics:gravityMagnitude = 500
}}
"""


def test_units_axes_and_transforms_are_honoured(tmp_path: Path) -> None:
    """A stage in centimetres and grams with z up and nested transforms is the scene that it describes."""
    grams = MATERIAL.replace("1e5", "1e6").replace("density = 1000", "density = 1")  # 1e5 Pa = 1e6 g/(cm s^2)
    path = write(
        tmp_path / "stage.usda",
        NESTED.format(body=tets(mesh=CUBE)),
        grams,
        head='upAxis = "Z"\n    metersPerUnit = 0.01\n    kilogramsPerUnit = 0.001',
    )
    scene = read(path)
    (body,) = scene.bodies
    # x in the group is y in the world, y is -x; z is turned over
    local = CUBE.points
    expected = np.column_stack([1.0 - 0.5 - local[:, 1], local[:, 0], 2.0 - local[:, 2]])
    np.testing.assert_allclose(body.mesh.points, expected, rtol=0, atol=1e-12)
    assert body.mesh.cell_volumes.sum() == pytest.approx(1.0)
    assert (body.material.E, body.density) == pytest.approx((1e5, 1000.0))
    assert scene.gravity == pytest.approx((0.0, 0.0, -5.0))
    plane, ball, step = scene.obstacles
    assert plane.normal == pytest.approx((0.0, np.sin(np.radians(20)), np.cos(np.radians(20))), abs=1e-9)
    assert (plane.point, plane.friction, ball.friction) == (pytest.approx((1.0, 0.0, 0.0)), 0.25, 0.0)
    assert (ball.center, ball.radius) == (pytest.approx((1.0, 0.0, -0.4)), pytest.approx(0.3))
    assert (step.center, step.size) == (pytest.approx((0.8, 0.1, -0.3)), pytest.approx((0.1, 0.2, 0.3)))
    turned = np.radians(120)  # by 90 and 30 degrees
    np.testing.assert_allclose(step.axes[0], (np.cos(turned), np.sin(turned), 0.0), atol=1e-6)


def test_the_same_scene_in_other_units_and_axes_moves_the_same(tmp_path: Path) -> None:
    ground = 'def Plane "Ground" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {{\n uniform token axis = "{}" {}\n}}'
    lifted = """
def Xform "Up"
{{
    double3 xformOp:translate = {}
    float3 xformOp:rotateXYZ = {}
    float3 xformOp:scale = {}
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]
    {}
}}
"""
    metres = write(
        tmp_path / "metres.usda",
        SCENE,
        MATERIAL,
        lifted.format((0, 0.01, 0), (0, 0, 0), (1, 1, 1), tets()),
        ground.format("Y", ""),
    )
    centimetres = write(
        tmp_path / "centimetres.usda",
        SCENE,
        MATERIAL.replace("1e5", "1e3").replace("= 1000", "= 0.001"),
        lifted.format((0, 0, 1), (90, 0, 0), (100, 100, 100), tets()),
        ground.format("Z", ""),
        head='upAxis = "Z"\n    metersPerUnit = 0.01',
    )
    ends = []
    for path in (metres, centimetres):
        simulation = wf.Simulation(replace(read(path), frames=4))
        *_, last = simulation.frames()
        ends.append(simulation.model.rest_points + last.displacement)
    assert ends[0][:, 1].min() < 0.0  # it has come down on the ground
    np.testing.assert_allclose(ends[1], ends[0][:, [0, 2, 1]] * (1, -1, 1), rtol=0, atol=2e-5)


def test_studies_take_stages(tmp_path: Path) -> None:
    write(tmp_path / "material.usda", MATERIAL)
    path = write(tmp_path / "stage.usda", SCENE, tets(), head=HEAD + "\n    subLayers = [@./material.usda@]")
    problem = Problem.of(path, frames=7)
    scene = problem.build(Setting.of(dt="1/60", element="P2")).scene
    assert (scene.dt, scene.frames, scene.bodies[0].mesh.order) == (pytest.approx(1 / 60), 7, 2)
    problem.require_same_files()
    write(tmp_path / "material.usda", MATERIAL.replace("1e5", "2e5"))
    with pytest.raises(wf.SceneError, match="not the file that the study was begun with"):
        problem.require_same_files()


def test_bodies_fall_as_galileo_says(tmp_path: Path) -> None:
    scene = read(write(tmp_path / "stage.usda", SCENE, tets(), MATERIAL))
    dt = 1.0 / 120.0
    assert scene.dt == pytest.approx(dt)
    *_, last = wf.Simulation(replace(scene, frames=12)).frames()
    # steps of backward Euler sum to g t (t + dt) / 2
    assert last.displacement[:, 1] == pytest.approx(-0.5 * GRAVITY * 0.5 * (0.5 + dt), rel=1e-5)


@pytest.mark.parametrize(
    ("scene", "up", "expected"),
    [
        ("", "Y", (0.0, -GRAVITY, 0.0)),
        ("", "Z", (0.0, 0.0, -GRAVITY)),
        ("float physics:gravityMagnitude = -inf", "Z", (0.0, 0.0, -GRAVITY)),
        ("float physics:gravityMagnitude = 0", "Y", None),
        ("float physics:gravityMagnitude = 1.62", "Y", (0.0, -1.62, 0.0)),
        ("vector3f physics:gravityDirection = (3, 0, -4)", "Y", (0.6 * GRAVITY, 0.0, -0.8 * GRAVITY)),
    ],
)
def test_gravity(tmp_path: Path, scene: str, up: str, expected: tuple | None) -> None:
    prim = f'def PhysicsScene "Scene" {{\n{scene}\n}}'
    path = write(tmp_path / "s.usda", prim, tets(), MATERIAL, head=f'upAxis = "{up}"\n    metersPerUnit = 1')
    gravity = stage_scene(str(path)).gravity
    assert gravity == (None if expected is None else pytest.approx(expected))


@pytest.mark.parametrize(
    ("material", "body", "expected"),
    [
        ("density = 500", "", 500.0),
        ("density = 0", "", 1000.0),
        ("restitution = 0", "", 1000.0),
        ("density = 500", "float physics:density = 300", 300.0),
        ("density = 500", "float physics:density = 300\n float physics:mass = 70", 70.0),
        ("density = 500", "float physics:mass = 0", 500.0),
    ],
)
def test_what_gives_the_density(tmp_path: Path, material: str, body: str, expected: float) -> None:
    apis = f'"{SIMULATION}", "PhysicsDeformableBodyAPI"'
    own = MATERIAL.replace("density = 1000", material)
    path = write(tmp_path / "stage.usda", SCENE, tets(apis=apis, more=body), own)
    assert read(path).bodies[0].density == pytest.approx(expected)


def test_subsets_of_tetrahedra_have_their_own_materials(tmp_path: Path) -> None:
    subset = """
    def GeomSubset "hard" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        uniform token elementType = "tetrahedron"
        int[] indices = [1, 3]
        rel material:binding:physics = </Hard>
    }
"""
    hard = MATERIAL.replace("Rubber", "Hard").replace("1e5", "1e7").replace("1000", "2000")
    path = write(tmp_path / "stage.usda", SCENE, tets(more=subset), MATERIAL, hard)
    (body,) = read(path).bodies
    assert list(body.material.E) == [1e5, 1e7, 1e5, 1e7, 1e5]
    assert list(body.density) == [1000, 2000, 1000, 2000, 1000]


def test_a_rest_shape_starts_a_body_deformed(tmp_path: Path) -> None:
    rest = 0.5 * CUBE.points + [0.0, 0.0, 7.0]
    path = write(
        tmp_path / "stage.usda", SCENE, tets(more=f"point3f[] physics:restShapePoints = {vectors(rest)}"), MATERIAL
    )
    (body,) = read(path).bodies
    np.testing.assert_array_equal(body.mesh.points, rest)
    np.testing.assert_allclose(body.mesh.points + body.initial_displacement(), CUBE.points, rtol=0, atol=1e-15)


ATTACHMENT = """
def PhysicsAttachment "Hold"
{{
    rel physics:src0 = </sim>
    rel physics:src1 = </Wall>
    uniform token physics:type0 = "point"
    uniform token physics:type1 = "{kind}"
    int[] physics:indices0 = {points}
    vector3f[] physics:coords1 = {places}
    {more}
}}
def Xform "Wall"
{{
    double3 xformOp:translate = (0, 0, 5)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}
"""


def attachment(kind: str = "xform", apart: float = 0.0, more: str = "") -> str:
    places = CUBE.points[[0, 2]] - [0, apart, 5]
    return ATTACHMENT.format(kind=kind, points="[0, 2]", places=vectors(places), more=more)


def test_attachments_to_a_fixed_frame_are_pins(tmp_path: Path) -> None:
    (body,) = read(write(tmp_path / "stage.usda", SCENE, tets(), MATERIAL, attachment())).bodies
    (pin,) = body.supports
    assert isinstance(pin, wf.Pin) and list(pin.points) == [0, 2]


def test_points_that_no_cell_uses_are_no_trouble(tmp_path: Path) -> None:
    mesh = wf.Mesh.box((1, 1, 1), (1, 1, 1))
    text = tets(mesh=mesh).replace("points = [", "points = [(9, 9, 9), ")
    for cell in mesh.cells:
        text = text.replace(str(tuple(int(i) for i in cell)), str(tuple(int(i) + 1 for i in cell)), 1)
    path = write(tmp_path / "stage.usda", SCENE, text, MATERIAL, attachment().replace("[0, 2]", "[1, 3]"))
    (body,) = read(path).bodies
    assert body.mesh.point_count == 8
    assert list(body.supports[0].points) == [0, 2]
    wf.run(replace(wf.read_stage(path), frames=1), tmp_path / "over.usda", over=path)
    assert points_at(tmp_path / "over.usda", "/sim", 1)[0].tolist() == [9, 9, 9]


def test_referenced_and_instanced_bodies(tmp_path: Path) -> None:
    write(tmp_path / "part.usda", f'def Xform "Part" {{ {tets()} }}', MATERIAL)
    instance = """
def Xform "{name}" (instanceable = true, references = @./part.usda@</Part>)
{{
    double3 xformOp:translate = ({x}, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    rel material:binding:physics = </Rubber> (bindMaterialAs = "strongerThanDescendants")
}}
"""
    instance = instance.replace("(instanceable = true, ref", "(\n    instanceable = true\n    ref").replace(
        "</Part>)", '</Part>\n    prepend apiSchemas = ["MaterialBindingAPI"]\n)'
    )
    path = write(
        tmp_path / "stage.usda", SCENE, instance.format(name="A", x=0), instance.format(name="B", x=5), MATERIAL
    )
    scene = read(path)
    assert [body.name for body in scene.bodies] == ["sim", "sim_2"]
    assert scene.bodies[1].mesh.points[:, 0].min() == 5.0
    out = tmp_path / "over.usda"
    wf.run(replace(scene, frames=2), out, over=path)
    for prim in ("/A/sim", "/B/sim"):
        moved = points_at(out, prim, 2)[:, 1] - CUBE.points[:, 1]
        assert moved == pytest.approx(-0.5 * GRAVITY * (1 / 12) * (1 / 12 + 1 / 120), rel=1e-4)


# ---- what is not understood, and what is broken


@pytest.mark.parametrize(
    ("prims", "expected"),
    [
        ('def PhysicsFixedJoint "Joint" {}', ["/Joint: PhysicsFixedJoint is not understood"]),
        (
            'def Capsule "Pill" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {}',
            ["/Pill: is no obstacle: obstacles are planes, spheres and boxes"],
        ),
        (
            'def Sphere "Egg" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {\n float3 xformOp:scale = (1, 2, 1)\n'
            ' uniform token[] xformOpOrder = ["xformOp:scale"]\n}',
            ["/Egg: is no obstacle: .* unequal scales"],
        ),
        (
            'def Cube "Crate" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsRigidBodyAPI"]) {}',
            ["/Crate: is no obstacle: /Crate is a rigid body that moves freely", "/Crate: PhysicsRigidBodyAPI is not"],
        ),
        (
            'def Plane "Belt" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {\n'
            " double3 xformOp:translate.timeSamples = { 0: (0, 0, 0), 9: (1, 0, 0) }\n"
            ' uniform token[] xformOpOrder = ["xformOp:translate"]\n}',
            ["/Belt: moves, but obstacles stand still"],
        ),
        (tets("Other", apis=f'"{SIMULATION}", "PhysxThingAPI"'), ["/Other: PhysxThingAPI is not understood"]),
        (
            tets("Frozen", more="bool physics:kinematicEnabled = true"),
            ["/Frozen: is not simulated: physics:kinematicEnabled is true"],
        ),
        (
            tets("Asleep", more="bool physics:startsAsleep = true"),
            ["/Asleep: physics:startsAsleep is left out: it moves from the start"],
        ),
        (
            f'def PointInstancer "Many" {{\n{tets("Seed")}\n'
            'def Plane "Floor" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {}\n}',
            ["/Many/Seed: is not simulated: it is a proto", "/Many/Floor: is no obstacle: it is a prototype"],
        ),
        (
            tets("Off", more="bool physics:bodyEnabled = false"),
            ["/Off: is not simulated: physics:bodyEnabled is false"],
        ),
        (
            tets("Bare").replace("rel material", "rel something"),
            ["/Bare: no material with PhysicsVolumeDeformableMaterialAPI gives it a Young's modulus: 1e\\+06 Pa"],
        ),
        (
            f'def Mesh "Shell" (prepend apiSchemas = ["{SIMULATION}"]) {{}}',
            ["/Shell: is not simulated: a volume deformable must be a TetMesh, not a Mesh"],
        ),
        (
            'def Mesh "Cloth" (prepend apiSchemas = ["PhysicsSurfaceDeformableSimAPI"]) {}',
            ["/Cloth: PhysicsSurfaceDeformableSimAPI is not understood"],
        ),
        (attachment(kind="segment"), ["/Hold: holds nothing: .* not 'point' to 'segment'"]),
        (attachment(apart=0.5), ["/Hold: holds nothing: its sites are 0.5 m apart"]),
        (attachment(more="float physics:stiffness = 9"), ["/Hold: holds nothing: its stiffness is finite"]),
        ('def PhysicsScene "Second" {}', ["/Second: is left out: all bodies are simulated in the first scene, /Scene"]),
        (
            tets("Heavy", more=f"float[] physics:masses = {[2.0] * 8}"),
            ["/Heavy: physics:masses gives the mass in all, which is spread evenly"],
        ),
        ('def Xform "Lost" (references = @./nowhere.usda@) {}', [".*nowhere.usda"]),
    ],
)  # fmt: skip
def test_what_is_not_understood_is_named(tmp_path: Path, prims: str, expected: list[str]) -> None:
    path = write(tmp_path / "stage.usda", SCENE, tets(), MATERIAL, prims)
    found = remarks(path)
    assert len(found) == len(expected), found
    for text, pattern in zip(found, expected, strict=True):
        assert re.match(pattern, text), text


def test_bodies_without_a_collider_touch_obstacles_all_the_same(tmp_path: Path) -> None:
    ground = 'def Plane "Ground" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {}'
    path = write(tmp_path / "stage.usda", SCENE, tets(apis=f'"{SIMULATION}"'), MATERIAL, ground)
    assert remarks(path) == ["/sim: has no collider, but touches the obstacles all the same"]


def test_the_friction_of_a_body_is_not_that_of_the_obstacle(tmp_path: Path) -> None:
    ground = 'def Plane "Ground" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {}'
    rough = MATERIAL.replace("float physics:density", "float physics:staticFriction = 0.5\n    float physics:density")
    found = remarks(write(tmp_path / "stage.usda", SCENE, tets(), rough, ground))
    assert found == ["/sim: the friction of /Rubber is left out: that of the obstacles counts"]


def test_without_units_numbers_are_metres(tmp_path: Path) -> None:
    path = write(tmp_path / "stage.usda", SCENE, tets(), MATERIAL, head='upAxis = "Y"')
    assert remarks(path) == ["it states no metersPerUnit: its numbers are taken as metres"]


def test_a_body_may_be_higher_up(tmp_path: Path) -> None:
    inner = f'def Xform "Parts" {{\n{tets()}\n}}'
    body = (
        f'def Xform "Toy" (prepend apiSchemas = ["PhysicsDeformableBodyAPI"]) {{\nfloat physics:mass = 40\n{inner}\n}}'
    )
    (own,) = read(write(tmp_path / "stage.usda", SCENE, body, MATERIAL)).bodies
    assert (own.name, own.density) == ("Toy", pytest.approx(40.0))


def test_a_stage_without_a_scene_has_the_gravity_of_the_earth(tmp_path: Path) -> None:
    path = write(tmp_path / "stage.usda", tets(), MATERIAL)
    assert remarks(path) == ["there is no PhysicsScene: gravity is 9.81 m/s^2, down"]


def test_thousands_of_unknown_prims_do_not_flood_the_terminal(tmp_path: Path) -> None:
    joints = "\n".join(f'def PhysicsFixedJoint "J{i}" {{}}' for i in range(25))
    found = remarks(write(tmp_path / "stage.usda", SCENE, tets(), MATERIAL, joints))
    assert len(found) == 21
    assert found[-1] == "5 more prims have physics that is not understood"


FLAT = 'float3 xformOp:scale = (1, 0, 1)\n uniform token[] xformOpOrder = ["xformOp:scale"]\n'


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("(1.0, 1.0, 1.0)", "(nan, 1.0, 1.0)"), "/sim: points has numbers that are not finite"),
        (("(7, ", "(8, "), "/sim: 1 of its 5 tetrahedra refer to points that it has not"),
        (("physics:poissonsRatio = 0.4", "physics:poissonsRatio = 0.7"), "/sim: .*nu"),
        (("float physics:youngsModulus = 1e5", "string physics:youngsModulus = 'soft'"), "/Rubber: .* a number"),
        (("physics:youngsModulus = 1e5", "physics:youngsModulus = -5"), "/sim: .*E"),
        (("physics:density = 1000", "physics:density = -1"), "/sim: .*density"),
        (("metersPerUnit = 1", "metersPerUnit = 0"), "metersPerUnit must be a finite number above 0"),
        (("metersPerUnit = 1", "metersPerUnit = 1\n    timeCodesPerSecond = 0"), "must be above 0"),
        ((f'"{SIMULATION}", ', ""), "nothing to simulate: no TetMesh can be, of /sim"),
        (("def TetMesh", "def Mesh"), "nothing to simulate: it has no TetMesh"),
        (('"Scene" {', '"Scene" { float physics:gravityMagnitude = nan\n'), "/Scene: .*finite"),
        (("rel material", FLAT + "rel material"), "/sim: its transform is singular"),
        (("#usda 1.0", "#usda 9.9"), "cannot be read as USD"),
        (("def TetMesh", "def TetMesh ((("), "cannot be read as USD"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore")
def test_broken_stages_are_refused(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    path = write(tmp_path / "stage.usda", SCENE, tets(), MATERIAL)
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(wf.WarpfemError, match=message) as caught:
        wf.read_stage(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("suffix", "contents"),
    [(".usd", b""), (".usda", bytes(range(256)) * 9), (".usdc", b"PXR-USDC\0\0\0"), (".usdz", b"PK\3\4nothing")],
)
@pytest.mark.usefixtures("child_process")
def test_files_that_are_no_stages_are_refused(tmp_path: Path, suffix: str, contents: bytes) -> None:
    path = tmp_path / f"broken{suffix}"
    path.write_bytes(contents)
    with pytest.raises(wf.SceneError, match="broken"):
        wf.read_stage(path)


def test_a_missing_stage_is_said(tmp_path: Path, capsys) -> None:
    assert main(["run", str(tmp_path / "none.usda")]) == 2
    assert "no scene file" in capsys.readouterr().err


# ---- layers over a stage

SKIN = """
def Mesh "skin"
{{
    point3f[] points = {points}
    int[] faceVertexCounts = [3, 3]
    int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
    normal3f[] normals = {normals} (interpolation = "vertex")
    uniform token subdivisionScheme = "none"
    double3 xformOp:translate = (0, 0, 100)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}
"""
SKIN_POINTS = np.array([(0.1, 0.2, 0.3), (0.9, 0.4, 0.1), (0.5, 1.4, 0.5), (0.2, 0.9, 2.0)])  # two are outside
CENTIMETRES = """upAxis = "Z"
    metersPerUnit = 0.01
    startTimeCode = 101
    endTimeCode = 103
    timeCodesPerSecond = 24
    defaultPrim = "Body"
"""


def artist(path: Path) -> Path:
    """A stage in centimetres of a body with a skin, a light and a camera."""
    inner = 100.0 * CUBE.points
    mesh = wf.Mesh(inner, CUBE.cells)
    skin = SKIN.format(
        points=vectors(100.0 * SKIN_POINTS - [0, 0, 100]), normals=vectors(np.tile([0.0, 0.6, 0.8], (4, 1)))
    )
    body = f"""
def Xform "Body" (prepend apiSchemas = ["PhysicsDeformableBodyAPI"])
{{
    double3 xformOp:translate = (0, 0, 500)
    float3 xformOp:rotateXYZ = (90, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
    {tets(mesh=mesh)}
    {skin}
}}
"""
    light = 'def SphereLight "Light" {}\ndef Camera "Camera" {}'
    material = MATERIAL.replace("1e5", "1e3").replace("= 1000", "= 0.001")
    return write(path, SCENE, body, light, material, head=CENTIMETRES)


@pytest.mark.usefixtures("child_process")
def test_a_layer_over_a_stage_has_the_motion_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    path = artist(tmp_path / "in" / "stage.usda")
    before = path.read_bytes()
    out = tmp_path / "out" / "moved.usda"
    assert main(["run", str(path), "--over", "--out", str(out), "--quiet"]) == 0
    assert path.read_bytes() == before

    layer = Sdf.Layer.FindOrOpen(str(out))
    assert list(layer.subLayerPaths) == ["../in/stage.usda"]
    said: list[Sdf.Path] = []
    layer.Traverse("/", said.append)
    moving = {"points", "velocities", "extent", "normals"}
    assert {path.name for path in said if path.IsPropertyPath()} == moving
    assert all(layer.GetPrimAtPath(path).specifier == Sdf.SpecifierOver for path in said if path.IsPrimPath())

    stage = Usd.Stage.Open(str(out))
    assert validation_errors(stage) == validation_errors(Usd.Stage.Open(str(path)))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (101, 103, 24)
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", 0.01)
    assert stage.GetDefaultPrim().GetPath() == "/Body" and stage.GetPrimAtPath("/Camera")

    pictured = read_pictured_stage(out)
    assert pictured.rest()[0].max(axis=0) == pytest.approx(pictured.frame(0)[0].points.max(axis=0), abs=1e-5)
    assert pictured.frame(2)[0].velocities is not None

    fall = 0.5 * 100 * GRAVITY * (2 / 24) * (2 / 24 + 1 / 120)  # cm, along local -y, as the body is turned
    for prim, rest in (("/Body/sim", 100.0 * CUBE.points), ("/Body/skin", 100.0 * SKIN_POINTS - [0, 0, 100])):
        np.testing.assert_allclose(points_at(out, prim, 101), rest, rtol=0, atol=1e-4)
        np.testing.assert_allclose(points_at(out, prim, 103), rest - [0, fall, 0], rtol=0, atol=2e-3)
        speed = np.array(stage.GetAttributeAtPath(f"{prim}.velocities").Get(103))
        np.testing.assert_allclose(speed, np.tile([0, -100 * GRAVITY * 2 / 24, 0], (len(rest), 1)), atol=1e-2)
        points = points_at(out, prim, 103)
        extent = np.array(stage.GetAttributeAtPath(f"{prim}.extent").Get(103))
        np.testing.assert_array_equal(extent, [points.min(axis=0), points.max(axis=0)])


A = np.array([[1.2, 0.3, 0.0], [-0.2, 0.9, 0.4], [0.1, 0.0, 1.5]])


def over_writer(tmp_path: Path) -> tuple[OverWriter, Path]:
    path = artist(tmp_path / "stage.usda")
    return OverWriter(tmp_path / "over.usdc", path, ["Body"], fps=24.0), path


def moved_affinely(body, shift: float) -> BodyFrame:
    x = body.start_points @ A.T + [shift, 2.0, 3.0]
    return BodyFrame(x, np.ones_like(x), np.zeros(0), np.zeros(0))


def test_a_skin_follows_an_affine_motion_exactly(tmp_path: Path) -> None:
    writer, path = over_writer(tmp_path)
    (body,) = stage_scene(str(path)).bodies
    with writer:
        writer.write_frame([moved_affinely(body, 1.0)])
    stage = Usd.Stage.Open(str(tmp_path / "over.usdc"))
    mesh = UsdGeom.Mesh.Get(stage, "/Body/skin")
    to_world = np.array(UsdGeom.XformCache(101.0).GetLocalToWorldTransform(mesh.GetPrim()))
    bound = np.array(mesh.GetPointsAttr().Get(), float) @ to_world[:3, :3] + to_world[3, :3]
    now = np.array(mesh.GetPointsAttr().Get(101.0), float) @ to_world[:3, :3] + to_world[3, :3]
    np.testing.assert_allclose(now, bound @ A.T + [100.0, 200.0, 300.0], rtol=0, atol=2e-4)
    normals = np.array(mesh.GetNormalsAttr().Get(101.0), float) @ to_world[:3, :3]
    expected = np.linalg.inv(A).T @ (to_world[:3, :3].T @ [0.0, 0.6, 0.8])
    np.testing.assert_allclose(normals, np.tile(expected / np.linalg.norm(expected), (4, 1)), rtol=0, atol=1e-6)


def test_an_embedding_holds_what_is_inside_and_beyond(rng) -> None:
    mesh = wf.Mesh.box((1, 1, 1), (3, 3, 3))
    places = rng.uniform(-2.0, 3.0, (200, 3))
    embedding = Embedding(mesh, places)
    np.testing.assert_allclose(embedding.points(mesh.points), places, rtol=0, atol=1e-12)
    np.testing.assert_allclose(embedding.points(mesh.points @ A.T + 5.0), places @ A.T + 5.0, rtol=0, atol=1e-12)
    # far outside it is the cell with the nearest centre that goes on
    far = np.array([9.0, 0.4, -5.0])
    nearest = mesh.cells[np.argmin(np.linalg.norm(mesh.points[mesh.cells].mean(axis=1) - far, axis=1))]
    moves = np.ones_like(mesh.points)
    moves[nearest] = 0.0
    assert np.abs(Embedding(mesh, far[None]).points(moves)).max() == 0.0
    # inside it is the interpolation, also of a motion that is not affine
    inner = rng.uniform(0.0, 1.0, (50, 3))
    bent = mesh.points + 0.2 * np.sin(mesh.points[:, [1, 2, 0]])
    change = Embedding(mesh, inner).points(bent) - inner
    assert np.abs(change - 0.2 * np.sin(inner[:, [1, 2, 0]])).max() < 0.2 / 8 / 3**2 * 3


def test_a_partial_layer_opens_over_the_stage(tmp_path: Path) -> None:
    """Also over a stage that has samples of its own."""
    writer, path = over_writer(tmp_path)
    stage = Usd.Stage.Open(str(path))
    UsdGeom.PointBased.Get(stage, "/Body/sim").GetPointsAttr().Set(points_at(path, "/Body/sim") + 7.0, 102.0)
    stage.Save()
    (body,) = stage_scene(str(path)).bodies
    for shift in (0.0, 1.0, 2.0):
        writer.write_frame([moved_affinely(body, shift)])
    writer.flush()
    partial = partial_path(tmp_path / "over.usdc")
    seen = [points_at(partial, prim, code) for prim in ("/Body/sim", "/Body/skin") for code in (101, 102, 103)]
    assert Usd.Stage.Open(str(partial)).GetPrimAtPath("/Camera")
    assert kept(tmp_path / "over.usdc") == f"3 frames are in {partial}"
    writer.close()
    assert kept(tmp_path / "over.usdc") == f"3 frames are in {tmp_path / 'over.usdc'}"
    assert not partial.exists()
    merged = [
        points_at(tmp_path / "over.usdc", prim, code)
        for prim in ("/Body/sim", "/Body/skin")
        for code in (101, 102, 103)
    ]
    for one, other in zip(seen, merged, strict=True):
        np.testing.assert_array_equal(one, other)
    assert np.abs(merged[1] - merged[0]).max() == pytest.approx(100.0, rel=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--out", "stage.usda", "--overwrite"], "stage.usda is the stage that is to be simulated"),
        (["--over", "--out", "stage.usda", "--overwrite"], "stage.usda is the stage that is to be simulated"),
        (["--over", "--resume", "--out", "o.usda"], "--over cannot be resumed"),
        (["--over", "--checkpoint-every", "2", "--out", "o.usda"], "--over cannot be resumed"),
        (["--set", "cells=3", "--out", "o.usda"], "has no parameter 'cells'. It has: dt"),
    ],
)
def test_what_a_run_of_a_stage_refuses(tmp_path: Path, monkeypatch, capsys, options: list[str], message: str) -> None:
    monkeypatch.chdir(tmp_path)
    artist(Path("stage.usda"))
    before = Path("stage.usda").read_bytes()
    assert main(["run", "stage.usda", *options]) == 2
    assert message in capsys.readouterr().err
    assert Path("stage.usda").read_bytes() == before
    assert os.listdir() == ["stage.usda"]


def test_over_wants_a_stage(tmp_path: Path, capsys) -> None:
    scene = tmp_path / "scene.py"
    scene.write_text(
        "import warpfem as wf\n\n\ndef scene():\n"
        "    body = wf.Body('b', wf.Mesh.box((1, 1, 1), (1, 1, 1)), wf.StableNeoHookean(E=1e5, nu=0.4))\n"
        "    return wf.Scene([body], wf.BackwardEuler(), frames=1)\n"
    )
    assert main(["run", str(scene), "--over", "--out", str(tmp_path / "o.usda")]) == 2
    assert "--over writes a layer over a USD stage" in capsys.readouterr().err
    with pytest.raises(wf.OutputError, match="has no body 'b' to go over; it has: Body"):
        wf.run(wf.Scene([_body()], wf.BackwardEuler()), tmp_path / "o.usda", over=artist(tmp_path / "stage.usda"))
    assert not (tmp_path / "o.usda").exists()


def _body() -> wf.Body:
    return wf.Body("b", CUBE, wf.StableNeoHookean(E=1e5, nu=0.4))


# ---- round trip


def demanding_scene() -> wf.Scene:
    soft = wf.Body(
        "soft one",
        wf.Mesh.box((1, 1, 1), (2, 2, 2), (0, 0.02, 0)),
        wf.NeoHookean(E=2e5, nu=0.3),
        density=np.where(np.arange(40) < 15, 800.0, 1200.0),
        displacement=lambda x: 0.02 * x[:, [1, 2, 0]],
        velocity=(0.0, -1.0, 0.0),
    )
    held = wf.Body(
        "held",
        wf.Mesh.box((1, 1, 1), (2, 1, 1), (100, 3, 0)),
        wf.StableNeoHookean(E=np.where(np.arange(10) < 5, 1e5, 1e6), nu=0.4),
        supports=[wf.Pin("left"), wf.Pin([5], axes=(0, 1, 2))],
    )
    turned = ((0.8, 0.6, 0.0), (-0.6, 0.8, 0.0), (0.0, 0.0, 1.0))
    return wf.Scene(
        [soft, held],
        wf.BackwardEuler(),
        dt=1 / 120,
        gravity=(1.0, -9.0, 0.0),
        damping=0.3,
        obstacles=[
            wf.Plane((0, 0, 0), (0.0, 2.0, 0.1), friction=0.3, stiffness=1e7),
            wf.Sphere((0.5, -1.0, 0.5), 1.01),
            wf.Box((1.5, 0.5, 0.5), (1.0, 0.5, 2.0), turned, friction=0.1),
            wf.BoxWalls((-90, -90, -90), (190, 90, 90)),
        ],
        fps=30.0,
        frames=3,
        up_axis="Z",
    )


def test_what_a_run_writes_is_a_stage_of_the_same_physics(tmp_path: Path) -> None:
    scene = demanding_scene()
    first, second = tmp_path / "first.usdc", tmp_path / "second.usdc"
    wf.run(scene, first)
    assert validation_errors(Usd.Stage.Open(str(first))) == []
    again = read(first)

    assert (again.fps, again.frames, again.up_axis, again.damping) == (30.0, 3, "Z", 0.3)
    assert again.gravity == pytest.approx(scene.gravity, rel=1e-6)
    assert len(again.obstacles) == 9
    for one, other in zip([*scene.obstacles[:3], *scene.obstacles[3].planes()], again.obstacles, strict=True):
        assert type(one) is type(other) and one.stiffness == other.stiffness
        assert one.friction == other.friction
        for name in {"point", "normal", "center", "radius", "size"} & set(vars(one)):
            assert getattr(other, name) == pytest.approx(getattr(one, name), abs=1e-6)
    np.testing.assert_allclose(again.obstacles[2].axes, scene.obstacles[2].axes, rtol=0, atol=1e-6)
    for one, other in zip(scene.bodies, again.bodies, strict=True):
        np.testing.assert_allclose(other.mesh.points, one.mesh.points, rtol=1e-6)
        np.testing.assert_array_equal(other.mesh.cells, one.mesh.cells)
        assert type(other.material) is type(one.material)
        for name in ("E", "nu"):
            np.testing.assert_array_equal(getattr(other.material, name), getattr(one.material, name))
        np.testing.assert_array_equal(other.density, one.density)
        np.testing.assert_allclose(other.initial_displacement(), one.initial_displacement(), rtol=0, atol=1e-6)
        np.testing.assert_array_equal(other.initial_velocity(), one.initial_velocity())
    assert [list(pin.points) for pin in again.bodies[1].supports] == [[0, 1, 2, 3, 5]]

    over = tmp_path / "over.usdc"  # carries the surfaces, with their normals, that the run had drawn
    wf.run(again, over, over=first)
    stage = Usd.Stage.Open(str(first))
    drawn = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/soft_one/soft_one_surface")).GetPrimvar("normals")
    moved = Usd.Stage.Open(str(over))
    carried = UsdGeom.PrimvarsAPI(moved.GetPrimAtPath("/World/soft_one/soft_one_surface")).GetPrimvar("normals")
    assert len(drawn.GetIndices()) > 0 and not carried.GetIndices()
    cosines = np.sum(np.array(drawn.ComputeFlattened(0)) * np.array(carried.ComputeFlattened(0)), axis=1)
    assert cosines.min() > 0.995 and validation_errors(moved) == []

    wf.run(again, second)
    for prim in ("/World/soft_one/simulation", "/World/held/simulation"):
        np.testing.assert_allclose(points_at(second, prim, 3), points_at(first, prim, 3), rtol=0, atol=2e-5)


def test_what_a_stage_has_no_words_for_is_said_when_it_is_read(tmp_path: Path) -> None:
    body = wf.Body(
        "b",
        CUBE,
        wf.StableNeoHookean(E=1e5, nu=0.4),
        supports=[wf.Pin("left", axes=(0,))],
        loads=[wf.Traction("right", (1.0, 0.0, 0.0))],
        element="quadratic",
    )
    wf.run(wf.Scene([body], wf.BackwardEuler(), frames=1), tmp_path / "run.usdc")
    assert remarks(tmp_path / "run.usdc") == [
        "/World/b/simulation: the scene that it comes from had quadratic cells, pins of single directions, tractions, "
        "which a stage has no words for: it runs without"
    ]
