# SPDX-License-Identifier: GPL-3.0-or-later
"""The arm and the elbow: their meshes, rigs, layers of deformation and actions; and the fixtures built from them."""

import math
from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.elbow import build_elbow
from fdda_addon.arm.joints import JOINT_INDEX, JOINT_NAMES, JOINTS, LOCKED, joint
from fdda_addon.arm.rig import build_arm
from fdda_addon.arm.sculpt import arm_field
from fdda_addon.arm.surface import Surface, sculpt_arm

FIXTURES = Path(__file__).resolve().parents[2] / "blend_fixtures"
VERTICES = {1: 1450, 2: 10_000, 3: 50_000}
FINGERS = ("index", "middle", "ring", "pinky")


@pytest.fixture(scope="module", params=[1, 2, pytest.param(3, marks=pytest.mark.slow)])
def surface(request) -> tuple[int, Surface]:
    return request.param, sculpt_arm(request.param)


@pytest.fixture(scope="module")
def arm_file(tmp_path_factory) -> Path:
    """The default arm, built once and saved."""
    file = tmp_path_factory.mktemp("arm") / "arm.blend"
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build_arm()
    bpy.ops.wm.save_as_mainfile(filepath=str(file))
    return file


@pytest.fixture
def animated(arm_file) -> tuple[bpy.types.Object, bpy.types.Object]:
    """The default arm, its file opened."""
    bpy.ops.wm.open_mainfile(filepath=str(arm_file))
    return bpy.data.objects["arm"], bpy.data.objects["arm_rig"]


@pytest.fixture
def arm(animated) -> tuple[bpy.types.Object, bpy.types.Object]:
    """The default arm, its action taken off so that tests can pose it."""
    animated[1].animation_data.action = None
    return animated


def evaluated(mesh_object: bpy.types.Object) -> np.ndarray:
    """(v, 3) float64 meters: the mesh after all its modifiers."""
    bpy.context.view_layer.update()
    mesh = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    positions = np.empty(len(mesh.vertices) * 3)
    mesh.vertices.foreach_get("co", positions)
    return positions.reshape(-1, 3)


def rest(mesh_object: bpy.types.Object) -> np.ndarray:
    positions = np.empty(len(mesh_object.data.vertices) * 3)
    mesh_object.data.vertices.foreach_get("co", positions)
    return positions.reshape(-1, 3)


def bend(rig: bpy.types.Object, name: str, x: float = 0.0, y: float = 0.0, z: float = 0.0):
    rig.pose.bones[name].rotation_euler = [math.radians(angle) for angle in (x, y, z)]


def assert_closed(points: np.ndarray, faces: np.ndarray):
    """Every edge between exactly two faces that run it in opposite directions, one sphere, outward."""
    directed = np.concatenate([faces[:, [i, (i + 1) % 4]] for i in range(4)])
    assert len(np.unique(directed, axis=0)) == len(directed)
    edges, uses = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    assert (uses == 2).all()
    assert len(points) - len(edges) + len(faces) == 2
    corners = points[faces]
    halves = [np.cross(corners[:, 1], corners[:, 2]), np.cross(corners[:, 2], corners[:, 3])]
    assert sum(np.einsum("ij,ij->i", corners[:, 0], half).sum() for half in halves) > 0


def test_density_sets_the_number_of_vertices(surface):
    density, arm = surface
    assert abs(len(arm.points) / VERTICES[density] - 1) < 0.06


def test_mesh_is_closed_and_faces_outward(surface):
    _, arm = surface
    assert arm.faces.shape[1] == 4
    assert all(len(set(face)) == 4 for face in arm.faces.tolist())
    assert_closed(arm.points, arm.faces)


def test_no_face_is_folded(surface):
    """Both halves of every quad look the way the sculpted surface does."""
    _, arm = surface
    distance, outward = arm_field().distance_and_gradient(arm.points)
    assert np.abs(distance).max() < 1e-4
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    corners, wanted = arm.points[arm.faces], outward[arm.faces].mean(axis=1)
    across = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", across, wanted).min() > 0.2


def test_it_measures_like_an_arm(surface):
    """Meters from the shoulder joint to the tip of the middle finger, and the order of the finger tips."""
    _, arm = surface
    tips = {name: arm.points[arm.joints == JOINT_INDEX[f"{name}_3"], 0].max() for name in FINGERS}
    assert tips["middle"] == pytest.approx(0.30 + 0.26 + 0.19, abs=0.01)
    assert tips["middle"] > tips["index"] > tips["pinky"] and tips["middle"] > tips["ring"] > tips["pinky"]
    assert arm.points[arm.joints == JOINT_INDEX["thumb_2"], 0].max() < tips["pinky"]


def test_no_finger_follows_another(surface):
    """Rest points of a finger lie about that finger's bones."""
    _, arm = surface
    for name in FINGERS:
        for i in (1, 2, 3):
            bone = joint(f"{name}_{i}")
            points = arm.points[arm.joints == JOINT_INDEX[bone.name]]
            side = points[:, 1] - (bone.head[1] + bone.tail[1]) / 2
            assert len(points) and np.abs(side).max() < 0.016


@pytest.mark.slow
def test_two_builds_are_identical():
    first, second = sculpt_arm(1), sculpt_arm(1)
    for name in ("points", "faces", "joints", "biceps", "nails"):
        assert np.array_equal(getattr(first, name), getattr(second, name))


@pytest.mark.parametrize("density", [0, 4, 1.5, "2"])
def test_other_densities_are_refused(density):
    with pytest.raises(ValueError, match="densities 1, 2 and 3"):
        build_arm(density)
    assert not bpy.data.objects


def test_joints_have_their_names_and_parents(arm):
    _, rig = arm
    parents = {"shoulder": None, "elbow": "shoulder", "wrist": "elbow"}
    for digit, count in {"thumb": 3, "index": 4, "middle": 4, "ring": 4, "pinky": 4}.items():
        parents |= {f"{digit}_{i}": f"{digit}_{i - 1}" if i else "wrist" for i in range(count)}
    assert len(parents) == 22
    assert {bone.name: bone.parent and bone.parent.name for bone in rig.data.bones} == parents
    assert [o.name for o in arm] == ["arm", "arm_rig"]


def test_every_bone_bends_about_its_x(arm):
    """A positive turn about local X moves the tail the way the joint table says it bends."""
    _, rig = arm
    for entry in JOINTS:
        matrix = rig.data.bones[entry.name].matrix_local
        assert np.allclose(matrix.col[2][:3], entry.bend, atol=1e-4), entry.name
        assert np.allclose(matrix.translation, entry.head, atol=1e-6)
    before = np.array(rig.pose.bones["elbow"].tail)
    bend(rig, "elbow", x=90)
    bpy.context.view_layer.update()
    moved = np.array(rig.pose.bones["elbow"].tail) - before
    assert np.allclose(moved, (-0.26, -0.26, 0.0), atol=1e-5)


def test_skinning_is_hard(arm):
    mesh_object, rig = arm
    groups = np.array([[(g.group, g.weight) for g in vertex.groups] for vertex in mesh_object.data.vertices])
    assert groups.shape[1] == 1 and (groups[..., 1] == 1.0).all()
    owned = np.bincount(groups[:, 0, 0].astype(int), minlength=22)
    assert [group.name for group in mesh_object.vertex_groups] == list(JOINT_NAMES)
    assert owned.min() >= 20
    assert [(m.name, m.type) for m in mesh_object.modifiers] == [
        ("Armature", "ARMATURE"),
        ("CorrectiveSmooth", "CORRECTIVE_SMOOTH"),
    ]
    skin = mesh_object.modifiers["Armature"]
    assert skin.object == rig and not skin.use_deform_preserve_volume and not skin.use_bone_envelopes


def test_rest_pose_is_the_rest_shape(arm):
    mesh_object, _ = arm
    assert np.abs(evaluated(mesh_object) - rest(mesh_object)).max() < 1e-6


def test_biceps_rises_with_the_elbow(arm):
    mesh_object, rig = arm
    keys = mesh_object.data.shape_keys
    driver = keys.animation_data.drivers[0].driver
    assert driver.is_simple_expression
    variable = driver.variables[0]
    assert (variable.type, variable.targets[0].transform_space) == ("TRANSFORMS", "LOCAL_SPACE")
    for angle, value in ((0, 0.0), (70, 0.5), (140, 1.0), (200, 1.0), (-30, 0.0)):
        bend(rig, "elbow", x=angle)
        bpy.context.view_layer.update()
        evaluated_keys = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.shape_keys
        assert evaluated_keys.key_blocks["biceps"].value == pytest.approx(value, abs=1e-4)


def test_biceps_bulges_on_the_front_of_the_upper_arm(arm):
    """What the key adds to the bent arm after the smoothing: about 17 mm, half way down, on the crease's side."""
    mesh_object, rig = arm
    key = mesh_object.data.shape_keys.key_blocks["biceps"]
    bend(rig, "elbow", x=140)
    contracted = evaluated(mesh_object)
    key.mute = True
    rise = np.linalg.norm(contracted - evaluated(mesh_object), axis=1)
    assert 0.014 < rise.max() < 0.020
    x, y, _ = rest(mesh_object)[rise.argmax()]
    assert 0.12 < x < 0.22 and y < -0.02
    owners = [JOINT_NAMES[vertex.groups[0].group] for vertex in mesh_object.data.vertices]
    assert rise[[owner not in ("shoulder", "elbow") for owner in owners]].max() < 1e-6


@pytest.mark.parametrize(
    ("name", "angle", "millimeters"), [("wrist", 60, 6.0), ("index_1", 70, 5.0), ("elbow", 90, 8.0)]
)
def test_smoothing_changes_the_bent_joint(arm, name, angle, millimeters):
    mesh_object, rig = arm
    smooth = mesh_object.modifiers["CorrectiveSmooth"]
    assert (smooth.rest_source, smooth.iterations) == ("ORCO", 10)
    bend(rig, name, x=angle)
    smoothed = evaluated(mesh_object)
    smooth.show_viewport = False
    change = np.linalg.norm(smoothed - evaluated(mesh_object), axis=1)
    assert change.max() > millimeters * 1e-3
    assert np.linalg.norm(rest(mesh_object)[change.argmax()] - joint(name).head) < 0.06


def test_range_of_motion_is_in_the_bones(arm):
    _, rig = arm
    for entry in JOINTS:
        bone = rig.pose.bones[entry.name]
        assert bone.rotation_mode == "XYZ" and all(bone.lock_location)
        for i, axis in enumerate("xyz"):
            low, high = entry.limits[i]
            assert getattr(bone, f"use_ik_limit_{axis}")
            assert math.degrees(getattr(bone, f"ik_min_{axis}")) == pytest.approx(low, abs=1e-3)
            assert math.degrees(getattr(bone, f"ik_max_{axis}")) == pytest.approx(high, abs=1e-3)
            assert bone.lock_rotation[i] == ((low, high) == LOCKED)
    assert joint("elbow").limits == ((0, 140), LOCKED, LOCKED)
    assert joint("shoulder").limits == ((-90, 90),) * 3
    assert all(joint(f"{name}_0").limits == ((-20, 20),) * 3 for name in FINGERS)


def outside(rig: bpy.types.Object) -> float:
    """How far, in degrees, the pose is outside the range of motion."""
    angles = np.degrees([rig.pose.bones[entry.name].rotation_euler for entry in JOINTS])
    limits = np.array([entry.limits for entry in JOINTS])
    return float(np.maximum(limits[..., 0] - angles, angles - limits[..., 1]).max())


def test_action_stays_inside_the_range_until_the_last_twenty_frames(animated):
    _, rig = animated
    scene = bpy.context.scene
    assert rig.animation_data.action.name == "arm_drive"
    assert (scene.frame_start, scene.frame_end, scene.frame_current) == (1, 250, 1)
    poses = set()
    for frame in range(1, 251):
        scene.frame_set(frame)
        assert (outside(rig) > 0.5) == (frame > 230), frame
        assert frame > 230 or outside(rig) < 1e-3, frame
        poses.add(tuple(round(angle, 4) for bone in rig.pose.bones for angle in bone.rotation_euler))
    assert len(poses) > 200
    scene.frame_set(240)
    assert abs(math.degrees(rig.pose.bones["index_0"].rotation_euler.x)) == pytest.approx(50, abs=0.1)
    assert abs(math.degrees(rig.pose.bones["elbow"].rotation_euler.z)) > 40


def test_building_leaves_the_preferences_alone():
    edit = bpy.context.preferences.edit
    edit.keyframe_new_interpolation_type = "CONSTANT"
    try:
        build_arm()
        assert edit.keyframe_new_interpolation_type == "CONSTANT"
    finally:
        edit.keyframe_new_interpolation_type = "BEZIER"


@pytest.mark.parametrize(("name", "build"), [("arm", build_arm), ("elbow", build_elbow)])
def test_fixture_is_what_the_script_builds_now(name, build):
    bpy.ops.wm.open_mainfile(filepath=str(FIXTURES / f"{name}.blend"))
    kept = bpy.data.objects[name]
    points, weights = rest(kept), [[(g.group, g.weight) for g in vertex.groups] for vertex in kept.data.vertices]
    faces = [tuple(polygon.vertices) for polygon in kept.data.polygons]
    bpy.context.scene.frame_set(10)
    posed = evaluated(kept)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    fresh, _ = build()
    assert points == pytest.approx(rest(fresh), abs=1e-6)
    assert faces == [tuple(polygon.vertices) for polygon in fresh.data.polygons]
    assert weights == [[(g.group, g.weight) for g in vertex.groups] for vertex in fresh.data.vertices]
    bpy.context.scene.frame_set(10)
    assert posed == pytest.approx(evaluated(fresh), abs=1e-5)
