# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh, rig, modifiers and action of the arm; the saved fixtures of arm and elbow match the code that builds them."""

import math
from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.elbow import build_elbow
from fdda_addon.arm.joints import JOINT_NAMES, JOINTS, LOCKED_RANGE
from fdda_addon.arm.rig import build_arm, read_surface

FIXTURES = Path(__file__).resolve().parents[3] / "blend_fixtures"


@pytest.fixture(scope="module")
def arm_file(tmp_path_factory) -> Path:
    """Build and save the default arm once."""
    file = tmp_path_factory.mktemp("arm") / "arm.blend"
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build_arm()
    bpy.ops.wm.save_as_mainfile(filepath=str(file))
    return file


@pytest.fixture
def animated(arm_file) -> tuple[bpy.types.Object, bpy.types.Object]:
    """Open the default arm; return its mesh object and its armature object."""
    bpy.ops.wm.open_mainfile(filepath=str(arm_file))
    return bpy.data.objects["arm"], bpy.data.objects["arm_rig"]


@pytest.fixture
def arm(animated) -> tuple[bpy.types.Object, bpy.types.Object]:
    """Open the default arm and remove its action, so that tests can pose the bones."""
    animated[1].animation_data.action = None
    return animated


def evaluated_positions(mesh_object: bpy.types.Object) -> np.ndarray:
    """Return the positions (V, 3) of the mesh after all modifiers, float64, in meters."""
    bpy.context.view_layer.update()
    mesh = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    positions = np.empty(len(mesh.vertices) * 3)
    mesh.vertices.foreach_get("co", positions)
    return positions.reshape(-1, 3)


def rest_positions(mesh_object: bpy.types.Object) -> np.ndarray:
    positions = np.empty(len(mesh_object.data.vertices) * 3)
    mesh_object.data.vertices.foreach_get("co", positions)
    return positions.reshape(-1, 3)


def bend(rig: bpy.types.Object, name: str, x: float = 0.0, y: float = 0.0, z: float = 0.0):
    rig.pose.bones[name].rotation_euler = [math.radians(angle) for angle in (x, y, z)]


def assert_closed(points: np.ndarray, faces: np.ndarray):
    """Assert that quads form one closed surface of the topology of a sphere, with normals that point outward."""
    directed = np.concatenate([faces[:, [i, (i + 1) % 4]] for i in range(4)])
    assert len(np.unique(directed, axis=0)) == len(directed)
    edges, uses = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    assert (uses == 2).all()
    assert len(points) - len(edges) + len(faces) == 2
    corners = points[faces]
    halves = [np.cross(corners[:, 1], corners[:, 2]), np.cross(corners[:, 2], corners[:, 3])]
    assert sum(np.einsum("ij,ij->i", corners[:, 0], half).sum() for half in halves) > 0


@pytest.mark.parametrize(("density", "vertices"), [(1, 1476), (2, 9960), (3, 50_618)])
def test_the_mesh_of_each_density_is_closed_and_faces_outward(density, vertices):
    arm = read_surface(density)
    assert len(arm.points) == vertices and arm.faces.shape[1] == 4
    assert all(len(set(face)) == 4 for face in arm.faces.tolist())
    assert_closed(arm.points, arm.faces)


def test_each_vertex_follows_one_bone(arm):
    mesh_object, rig = arm
    groups = np.array([[(g.group, g.weight) for g in vertex.groups] for vertex in mesh_object.data.vertices])
    assert groups.shape[1] == 1 and (groups[..., 1] == 1.0).all()
    vertex_counts = np.bincount(groups[:, 0, 0].astype(int), minlength=22)
    assert [group.name for group in mesh_object.vertex_groups] == list(JOINT_NAMES)
    assert vertex_counts.min() >= 20
    assert [(m.name, m.type) for m in mesh_object.modifiers] == [
        ("Armature", "ARMATURE"),
        ("CorrectiveSmooth", "CORRECTIVE_SMOOTH"),
    ]
    skin = mesh_object.modifiers["Armature"]
    assert skin.object == rig and not skin.use_deform_preserve_volume and not skin.use_bone_envelopes


def test_the_rest_pose_shows_the_undeformed_mesh(arm):
    mesh_object, _ = arm
    assert np.abs(evaluated_positions(mesh_object) - rest_positions(mesh_object)).max() < 1e-6


def test_the_elbow_drives_the_biceps_shape_key(arm):
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


def test_ik_limits_and_locks_define_the_range_of_motion(arm):
    _, rig = arm
    for entry in JOINTS:
        bone = rig.pose.bones[entry.name]
        assert bone.rotation_mode == "XYZ" and all(bone.lock_location)
        for i, axis in enumerate("xyz"):
            low, high = entry.limits[i]
            assert getattr(bone, f"use_ik_limit_{axis}")
            assert math.degrees(getattr(bone, f"ik_min_{axis}")) == pytest.approx(low, abs=1e-3)
            assert math.degrees(getattr(bone, f"ik_max_{axis}")) == pytest.approx(high, abs=1e-3)
            assert bone.lock_rotation[i] == ((low, high) == LOCKED_RANGE)


def degrees_outside_range(rig: bpy.types.Object) -> float:
    """Return the largest angle by which the pose exceeds the range of motion, in degrees."""
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
        assert (degrees_outside_range(rig) > 0.5) == (frame > 230), frame
        assert frame > 230 or degrees_outside_range(rig) < 1e-3, frame
        poses.add(tuple(round(angle, 4) for bone in rig.pose.bones for angle in bone.rotation_euler))
    assert len(poses) > 200
    scene.frame_set(240)
    assert abs(math.degrees(rig.pose.bones["index_0"].rotation_euler.x)) == pytest.approx(50, abs=0.1)
    assert abs(math.degrees(rig.pose.bones["elbow"].rotation_euler.z)) > 40


@pytest.mark.parametrize(
    ("name", "build", "frames"), [("arm", build_arm, (110, 190, 240)), ("elbow", build_elbow, (10,))]
)
def test_the_saved_fixture_equals_a_newly_built_one(name, build, frames):
    """The fixture has the bones, the weights, the action and the deformers that were once looked at."""

    def state(mesh_object: bpy.types.Object) -> tuple[list, np.ndarray]:
        positions = [rest_positions(mesh_object)]
        for frame in frames:
            bpy.context.scene.frame_set(frame)
            positions.append(evaluated_positions(mesh_object))
        bones = [(bone.name, bone.parent and bone.parent.name) for bone in bpy.data.objects[f"{name}_rig"].data.bones]
        weights = [[(g.group, g.weight) for g in vertex.groups] for vertex in mesh_object.data.vertices]
        return [bones, weights, [tuple(polygon.vertices) for polygon in mesh_object.data.polygons]], np.array(positions)

    bpy.ops.wm.open_mainfile(filepath=str(FIXTURES / f"{name}.blend"))
    saved, saved_positions = state(bpy.data.objects[name])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    built, positions = state(build()[0])
    assert built == saved
    np.testing.assert_allclose(positions, saved_positions, atol=1e-5)
