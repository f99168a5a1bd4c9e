# SPDX-License-Identifier: GPL-3.0-or-later
"""What a fast rig keeps: every way in which bones and drivers depend on bones, and the control bones."""

import bpy
import numpy as np
import pytest

from blend_fixtures.characters.bones import NewBone, add_bones
from blend_fixtures.characters.dependencies import CONTROLS, DEPENDENCIES, SOURCE, UNUSED, studio_arm
from fdda_addon.core.errors import RigError
from fdda_addon.core.progress import run_job
from fdda_addon.fast_rig.compared_poses import ComparedPoses, differing_bones, evaluate_poses
from fdda_addon.fast_rig.controls import control_bones
from fdda_addon.fast_rig.graph_reader import read_graph
from fdda_addon.fast_rig.removal import remove_bones, remove_drivers, remove_unneeded
from fdda_addon.rig.dependencies import read_dependencies
from fdda_addon.rig.references import Node
from fdda_addon.scene.node_groups import BONE_NODE
from fdda_addon.scene.scene_rig import SceneRig

from ..conftest import ELBOW
from ..waves import wave

REPLACED = {ELBOW: {"Armature", "Mush", "Lattice"}}
POSE_COUNT = 12
SIZE = 0.5
"""Length of the arm, meters."""
BENDY, HANDLE = "bendy", "handle"


def kept_for_joints(scene_rig: SceneRig) -> tuple[set[Node], set[Node]]:
    """Return all nodes of the dependency graph, and those that `lower` needs."""
    graph = read_graph([scene_rig], REPLACED)
    return graph.nodes, graph.kept([Node(scene_rig.armature_object, "lower")])


def joint_matrices(scene_rig: SceneRig, *control_names: str) -> tuple[ComparedPoses, np.ndarray]:
    """Evaluate `lower` in some random poses of control bones."""
    poses = ComparedPoses(scene_rig.armature_object, ("lower",), control_names, (), SIZE, pose_count=POSE_COUNT)
    return poses, run_job(evaluate_poses(poses, "poses")).matrices


@pytest.mark.parametrize("name", DEPENDENCIES)
def test_a_joint_keeps_the_bones_that_it_depends_on(name):
    scene_rig = SceneRig(*studio_arm(name))
    armature_object, source = scene_rig.armature_object, f"{SOURCE}.{name}"
    nodes, kept = kept_for_joints(scene_rig)
    poses, full = joint_matrices(scene_rig, "control", source)

    remove_drivers([scene_rig], nodes, kept, frozenset())
    assert set(remove_bones(armature_object, kept)) == {UNUSED, f"{UNUSED}_child"}
    _, fast = joint_matrices(scene_rig, "control", source)
    assert differing_bones(poses, full, fast, 0.0) == {}

    # The same comparison finds the difference if the bone is missing.
    missing = kept - {Node(armature_object, source)}
    remove_drivers([scene_rig], nodes, missing, frozenset())
    assert remove_bones(armature_object, missing) == [source]
    _, broken = joint_matrices(scene_rig, "control")
    assert differing_bones(poses, full, broken, 1e-3).keys() == {"lower"}


@pytest.mark.parametrize(
    ("kind", "object_property", "bone_property"),
    [
        ("HOOK", "object", "subtarget"),
        ("WARP", "object_from", "bone_from"),
        ("WAVE", "start_position_object", ""),
        ("DISPLACE", "texture_coords_object", "texture_coords_bone"),
        ("UV_WARP", "object_to", "bone_to"),
    ],
)
def test_a_mesh_depends_on_the_bones_that_its_modifiers_name(kind, object_property, bone_property, scene_rig):
    modifier = scene_rig.mesh_object.modifiers.new("Modifier", kind)
    setattr(modifier, object_property, scene_rig.armature_object)
    if bone_property:
        setattr(modifier, bone_property, UNUSED)
    assert (UNUSED in read_dependencies(scene_rig).bones) == bool(bone_property)


def test_a_bone_keeps_the_bone_at_which_its_custom_shape_is_drawn(scene_rig):
    armature_object = scene_rig.armature_object
    bone = armature_object.pose.bones["control"]
    bone.custom_shape, bone.custom_shape_transform = scene_rig.mesh_object, armature_object.pose.bones[UNUSED]
    kept = read_graph([scene_rig], REPLACED).kept([Node(armature_object, "control")])
    assert Node(armature_object, UNUSED) in kept


def test_muted_constraints_count_only_if_animation_unmutes_them():
    scene_rig = SceneRig(*studio_arm("target"))
    armature_object, source = scene_rig.armature_object, f"{SOURCE}.target"
    constraint = armature_object.pose.bones["lower"].constraints[source]
    constraint.mute = True
    assert Node(armature_object, source) not in kept_for_joints(scene_rig)[1]
    constraint.driver_add("mute")
    assert Node(armature_object, source) in kept_for_joints(scene_rig)[1]


def test_control_bones_are_visible_or_keyed_or_in_a_collection():
    armature_object = studio_arm("action")[1]
    wave(armature_object, UNUSED)
    assert control_bones(armature_object, ["visible"]) == {"control"}
    # The action that only a constraint plays keys no controls.
    assert control_bones(armature_object, ["keyed"]) == {UNUSED}
    assert control_bones(armature_object, ["visible", "keyed"]) == {"control", UNUSED}
    assert control_bones(armature_object, [f"collection:{CONTROLS}"]) == {"control"}
    with pytest.raises(RigError, match=r"has no bone collection 'Faces'; its collections: 'Controls', 'Mechanism'\."):
        control_bones(armature_object, ["collection:Faces"])
    armature_object.data.collections.new("Empty")
    with pytest.raises(RigError, match=r"The bone collection 'Empty' of '.*' has no bones; assign bones to it"):
        control_bones(armature_object, ["visible", "collection:Empty"])


def test_a_driven_property_of_the_scene_is_followed():
    scene_rig = SceneRig(*studio_arm("target"))
    armature_object, scene = scene_rig.armature_object, bpy.context.scene
    scene["bend"] = 0.0
    for owner, target_id, path in (
        (scene.driver_add('["bend"]'), armature_object, f'pose.bones["{UNUSED}"].location[0]'),
        (armature_object.pose.bones["lower"].driver_add("rotation_euler", 0), scene, '["bend"]'),
    ):
        owner.driver.type = "SUM"
        target = owner.driver.variables.new().targets[0]
        target.id_type = target_id.id_type
        target.id, target.data_path = target_id, path
    assert Node(armature_object, UNUSED) in kept_for_joints(scene_rig)[1]


def drive(curve: bpy.types.FCurve, target_id: bpy.types.ID, path: str) -> None:
    """Set a driver to the value at a path of a datablock."""
    curve.driver.type = "SUM"
    target = curve.driver.variables.new().targets[0]
    target.id, target.data_path = target_id, path


def test_the_drivers_of_the_world_keep_their_bones(scene_rig):
    """A fast rig may be rendered from its own file, too."""
    world = bpy.context.scene.world = bpy.data.worlds.new("world")
    drive(world.driver_add("color", 0), scene_rig.armature_object, f'pose.bones["{UNUSED}"].location[0]')
    removed = remove_unneeded([scene_rig], ["lower"], ["control"])
    assert removed.bones == {f"{UNUSED}_child"} and len(world.animation_data.drivers) == 1


@pytest.mark.parametrize("expression", ['self.id_data["bend"]', 'self["bend"]'])
def test_an_expression_with_self_keeps_the_drivers_of_what_it_reads(expression, scene_rig):
    """`self` is a bone or the armature object, whose custom property another bone drives."""
    armature_object = scene_rig.armature_object
    armature_object["bend"] = 0.0
    drive(armature_object.driver_add('["bend"]'), armature_object, f'pose.bones["{UNUSED}"].location[0]')
    owner = armature_object.pose.bones["lower"] if "id_data" in expression else armature_object
    curve = owner.driver_add("scale", 0)
    curve.driver.expression = expression
    assert Node(armature_object, UNUSED) not in kept_for_joints(scene_rig)[1]
    curve.driver.use_self = True
    assert Node(armature_object, UNUSED) in kept_for_joints(scene_rig)[1]


@pytest.fixture
def bendy_arm() -> SceneRig:
    """The arm with a hidden deforming B-Bone, which has a handle and a driven easing."""
    scene_rig = SceneRig(*studio_arm())
    armature_object = scene_rig.armature_object
    add_bones(
        armature_object,
        NewBone(BENDY, (0.0, 0.2, 0.0), (0.2, 0.2, 0.0), "lower"),
        NewBone(HANDLE, (0.2, 0.2, 0.0), (0.3, 0.2, 0.0), is_deforming=False),
    )
    bones = armature_object.data.bones
    armature_object.data.collections["Mechanism"].assign(bones[BENDY])
    armature_object.data.collections["Mechanism"].assign(bones[HANDLE])
    bones[BENDY].bbone_segments, bones[BENDY].bbone_handle_type_end = 8, "ABSOLUTE"
    bones[BENDY].bbone_custom_handle_end = bones[HANDLE]
    pose_bone = armature_object.pose.bones[BENDY]
    drive(pose_bone.driver_add("bbone_easein"), armature_object, f'pose.bones["{UNUSED}"].location[0]')
    return scene_rig


def test_a_curve_that_nothing_reads_goes_with_its_handle_and_its_driver(bendy_arm):
    armature_object = bendy_arm.armature_object
    # A cage that no render shows goes, so it reads nothing.
    cage = bpy.data.objects.new("unrendered cage", bpy.data.meshes.new("cage"))
    bpy.context.scene.collection.objects.link(cage)
    cage.vertex_groups.new(name=BENDY)
    cage.modifiers.new("Armature", "ARMATURE").object = armature_object
    cage.hide_render = True
    removed = remove_unneeded([bendy_arm], [BENDY], ["control"])
    assert removed.bones == {HANDLE, UNUSED, f"{UNUSED}_child"}
    assert armature_object.data.bones[BENDY].bbone_segments == 1
    assert not armature_object.animation_data.drivers


@pytest.mark.parametrize(
    "reader", ["control", "modifier", "parent", "constraint", "armature constraint", "constraint of the mesh"]
)
def test_a_curve_stays_if_something_reads_it(bendy_arm, reader):
    """Animators see controls; other objects and constraints follow the curve."""
    armature_object = bendy_arm.armature_object
    other = bpy.data.objects.new("cloth", bpy.data.meshes.new("cloth"))
    bpy.context.scene.collection.objects.link(other)
    other.vertex_groups.new(name=BENDY)
    if reader == "modifier":
        other.modifiers.new("Armature", "ARMATURE").object = armature_object
    elif reader == "parent":
        other.parent, other.parent_type = armature_object, "ARMATURE"
    elif reader.startswith("constraint"):
        owner = other if reader == "constraint" else bendy_arm.mesh_object
        constraint = owner.constraints.new("COPY_LOCATION")
        constraint.target, constraint.subtarget, constraint.use_bbone_shape = armature_object, BENDY, True
    elif reader == "armature constraint":
        target = other.constraints.new("ARMATURE").targets.new()
        target.target, target.subtarget = armature_object, BENDY
    controls = ["control", *([BENDY] if reader == "control" else [])]
    removed = remove_unneeded([bendy_arm], [BENDY], controls)
    assert removed.bones == {f"{UNUSED}_child"}
    assert armature_object.data.bones[BENDY].bbone_segments == 8 and len(armature_object.animation_data.drivers) == 1


def grease_pencil_object() -> bpy.types.Object:
    """Create an object with strokes; Blender 4.5 creates it only with an operator."""
    bpy.ops.object.grease_pencil_add(type="EMPTY")
    return bpy.context.object


def test_the_curve_of_a_bone_that_deforms_strokes_stays(bendy_arm):
    armature_object = bendy_arm.armature_object
    strokes = grease_pencil_object()
    strokes.vertex_groups.new(name=BENDY)
    strokes.modifiers.new("Armature", "GREASE_PENCIL_ARMATURE").object = armature_object
    removed = remove_unneeded([bendy_arm], ["lower"], ["control"])
    assert removed.bones == {f"{UNUSED}_child"}
    assert armature_object.data.bones[BENDY].bbone_segments == 8


@pytest.mark.skipif(not hasattr(bpy.types, BONE_NODE), reason="this Blender has no node Bone Info")
@pytest.mark.parametrize("is_linked", [False, True])
def test_a_node_keeps_the_bones_that_it_may_read(is_linked, scene_rig):
    armature_object = scene_rig.armature_object
    tree = bpy.data.node_groups.new("bones", "GeometryNodeTree")
    node = tree.nodes.new(BONE_NODE)
    node.inputs["Armature"].default_value, node.inputs["Bone Name"].default_value = armature_object, UNUSED
    if is_linked:
        tree.links.new(tree.nodes.new("FunctionNodeInputString").outputs[0], node.inputs["Bone Name"])
    other = bpy.data.objects.new("prop", bpy.data.meshes.new("prop"))
    bpy.context.scene.collection.objects.link(other)
    other.modifiers.new("Nodes", "NODES").node_group = tree
    removed = remove_unneeded([scene_rig], ["lower"], ["control"])
    assert removed.bones == (set() if is_linked else {f"{UNUSED}_child"})
