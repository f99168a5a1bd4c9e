# SPDX-License-Identifier: GPL-3.0-or-later
"""Linear skinning equals Blender's Armature modifier for all kinds of weights."""

from collections.abc import Callable

import bpy
import numpy as np
import pytest

from blend_fixtures.elbow import build_elbow
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.rig import STATIC_JOINT
from fdda_addon.rig.reading import PoseEvaluator, read_rig
from fdda_addon.scene.scene_rig import find_rig

from ..conftest import ELBOW, evaluated_positions, pose

EXACT = 2e-6


@pytest.fixture
def smooth() -> bpy.types.Object:
    """The elbow with several weights per vertex and no modifier but its Armature modifier."""
    build_elbow()
    mesh_object = bpy.data.objects[ELBOW]
    for modifier in list(mesh_object.modifiers)[1:]:
        mesh_object.modifiers.remove(modifier)
    mesh_object.shape_key_clear()
    along = np.array([vertex.co.z for vertex in mesh_object.data.vertices])
    along = (along - along.min()) / np.ptp(along)
    for name, weights in (("upper", 1 - along), ("lower", along)):
        for vertex, weight in enumerate(weights.tolist()):
            mesh_object.vertex_groups[name].add([vertex], weight, "REPLACE")
    return mesh_object


def armature_of(mesh_object: bpy.types.Object) -> bpy.types.Armature:
    return mesh_object.modifiers[0].object.data


def plain(mesh_object: bpy.types.Object) -> None:
    pass


def unnormalized(mesh_object: bpy.types.Object) -> None:
    for vertex in range(0, 40, 3):
        mesh_object.vertex_groups["upper"].add([vertex], 0.9, "REPLACE")
        mesh_object.vertex_groups["lower"].add([vertex], 0.7, "REPLACE")


def missing(mesh_object: bpy.types.Object) -> None:
    for group in mesh_object.vertex_groups:
        group.remove(range(10, 30))
    mesh_object.vertex_groups["upper"].add([12], 0.00005, "REPLACE")
    mesh_object.vertex_groups["lower"].add([13], 0.0, "REPLACE")
    mesh_object.vertex_groups["lower"].add([14], 0.001, "REPLACE")


def without_groups(mesh_object: bpy.types.Object) -> None:
    mesh_object.vertex_groups.clear()


def mask(mesh_object: bpy.types.Object) -> None:
    group = mesh_object.vertex_groups.new(name="mask")
    for vertex in range(len(mesh_object.data.vertices)):
        if vertex % 5:
            group.add([vertex], vertex % 5 / 4, "REPLACE")
    mesh_object.modifiers[0].vertex_group = "mask"


def inverted_mask(mesh_object: bpy.types.Object) -> None:
    mask(mesh_object)
    mesh_object.modifiers[0].invert_vertex_group = True


def envelopes(mesh_object: bpy.types.Object) -> None:
    mesh_object.modifiers[0].use_vertex_groups = False
    mesh_object.modifiers[0].use_bone_envelopes = True
    for bone, weight in zip(armature_of(mesh_object).bones, (1.0, 0.4), strict=True):
        bone.head_radius, bone.tail_radius, bone.envelope_distance = 0.03, 0.05, 0.1
        bone.envelope_weight = weight


def envelopes_where_groups_are_missing(mesh_object: bpy.types.Object) -> None:
    envelopes(mesh_object)
    mesh_object.modifiers[0].use_vertex_groups = True
    missing(mesh_object)


def narrow_envelopes(mesh_object: bpy.types.Object) -> None:
    envelopes(mesh_object)
    for bone in armature_of(mesh_object).bones:
        bone.head_radius, bone.tail_radius, bone.envelope_distance = 0.01, 0.02, 0.02


def multiplied(mesh_object: bpy.types.Object) -> None:
    envelopes(mesh_object)
    mesh_object.modifiers[0].use_bone_envelopes = False
    mesh_object.modifiers[0].use_vertex_groups = True
    armature_of(mesh_object).bones["lower"].use_envelope_multiply = True


def a_bone_that_does_not_deform(mesh_object: bpy.types.Object) -> None:
    armature_of(mesh_object).bones["lower"].use_deform = False


def envelopes_of_no_bone(mesh_object: bpy.types.Object) -> None:
    envelopes(mesh_object)
    for bone in armature_of(mesh_object).bones:
        bone.use_deform = False


CASES = (
    *(plain, unnormalized, missing, without_groups, mask, inverted_mask, envelopes, narrow_envelopes),
    *(envelopes_where_groups_are_missing, multiplied, a_bone_that_does_not_deform, envelopes_of_no_bone),
)


@pytest.mark.parametrize("change", CASES)
def test_linear_skinning_equals_the_armature_modifier(smooth: bpy.types.Object, change: Callable):
    change(smooth)
    scene_rig = find_rig()
    rig = read_rig(scene_rig)
    assert np.allclose(rig.skin_weights.sum(axis=1), 1, atol=1e-6) and (rig.skin_weights >= 0).all()
    evaluator, skinning = PoseEvaluator(scene_rig, rig), LinearSkinning(rig)
    moved = 0.0
    for angle in (0.0, 0.7, -1.2):
        pose(angle=angle)
        pose(angle=angle / 3, bone="upper")
        matrices, positions, _ = evaluator.evaluate()
        assert np.array_equal(positions, evaluated_positions(smooth))
        moved = max(moved, np.abs(positions - rig.rest_positions).max())
        assert np.abs(skinning.positions(matrices[None])[0] - positions).max() < EXACT
    assert moved > 0.01 or change in (without_groups, envelopes_of_no_bone)


@pytest.mark.parametrize("change", [missing, mask, without_groups])
def test_vertices_without_weights_follow_the_static_joint(smooth: bpy.types.Object, change: Callable):
    change(smooth)
    rig = read_rig(find_rig())
    (unmoved,) = (number for number, joint in enumerate(rig.joints) if joint.name == STATIC_JOINT)
    assert rig.joints[unmoved].parent == -1 and np.array_equal(rig.rest_matrices[unmoved], np.eye(4))
    assert rig.skin_weights[rig.skin_joints == unmoved].sum() > 1


def test_a_rig_read_with_its_own_joints_is_the_same(smooth: bpy.types.Object):
    missing(smooth)
    first = read_rig(find_rig())
    again = read_rig(find_rig(), first.joint_names)
    assert again.joints == first.joints and again.meshes[0].fingerprint == first.meshes[0].fingerprint
