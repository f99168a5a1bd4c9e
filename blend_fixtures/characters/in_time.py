# SPDX-License-Identifier: GPL-3.0-or-later
"""Build characters that depend on time; each function builds one in the current scene.

Something of each is keyed or driven. The surfaces of the characters in `HARMLESS` still depend only on the pose.
"""

from collections.abc import Callable

import bpy

from . import controls, stacks
from .base import bulge, link, tube
from .bones import remove_constraints
from .controls import add_key, add_property, drive_by_property
from .skinning import two_armatures


def insert_keys(owner: bpy.types.bpy_struct, path: str, first_value: object, last_value: object) -> None:
    """Insert keyframes of a property at frames 1 and 30, and go to frame 1."""
    for frame, value in ((1, first_value), (30, last_value)):
        if path.startswith('["'):
            owner[path[2:-2]] = value
        else:
            setattr(owner, path, value)
        owner.keyframe_insert(path, frame=frame)
    bpy.context.scene.frame_set(1)


def build_smoothed_tube() -> bpy.types.Modifier:
    """Build a tube with a Smooth modifier after the skinning; return the modifier."""
    stacks.smooth()
    return bpy.data.objects["elbow"].modifiers["Smooth"]


def keyed_strength() -> None:
    insert_keys(build_smoothed_tube(), "factor", 0.0, 1.0)


def strength_in_the_nla() -> None:
    insert_keys(build_smoothed_tube(), "factor", 0.0, 1.0)
    animation = bpy.data.objects["elbow"].animation_data
    action, slot = animation.action, animation.action_slot
    animation.action = None
    strip = animation.nla_tracks.new().strips.new("strip", 1, action)
    strip.action_slot = slot


def driven_by_frame() -> None:
    build_smoothed_tube().driver_add("factor").driver.expression = "min(1, frame / 30)"


def driven_by_the_scene() -> None:
    _drive_by_frame("SINGLE_PROP")


def driven_by_the_context() -> None:
    _drive_by_frame("CONTEXT_PROP")


def through_a_property() -> None:
    """A property of the mesh object drives the strength, and the frame drives the property."""
    modifier, mesh_object = build_smoothed_tube(), bpy.data.objects["elbow"]
    add_property(mesh_object, "softness")
    drive_by_property(modifier, "factor", mesh_object, '["softness"]')
    mesh_object.driver_add('["softness"]').driver.expression = "min(1, frame / 30)"


def keyed_property_without_a_range() -> None:
    modifier, armature_object = build_smoothed_tube(), bpy.data.objects["elbow_rig"]
    armature_object["soft"] = 0.0
    drive_by_property(modifier, "factor", armature_object, '["soft"]')
    insert_keys(armature_object, '["soft"]', 0.0, 1.0)


def property_of_the_scene() -> None:
    modifier, scene = build_smoothed_tube(), bpy.context.scene
    scene["soft"] = 0.0
    driver = modifier.driver_add("factor").driver
    variable = driver.variables.new()
    variable.name, variable.targets[0].id_type = "soft", "SCENE"
    variable.targets[0].id, variable.targets[0].data_path = scene, '["soft"]'
    driver.expression = "soft"
    insert_keys(scene, '["soft"]', 0.0, 1.0)


def shape_driven_by_frame() -> None:
    mesh_object, _ = tube()
    add_key(mesh_object, "flexed", bulge).driver_add("value").driver.expression = "min(1, frame / 30)"


def keyed_evaluation_time() -> None:
    stacks.absolute_shape_keys()
    keys = bpy.data.objects["elbow"].data.shape_keys
    keys.driver_remove("eval_time")
    insert_keys(keys, "eval_time", 0.0, 10.0)


def keyed_lattice() -> None:
    stacks.lattice()
    insert_keys(bpy.data.objects["lattice"], "location", (0.25, 0.0, 0.0), (0.25, 0.0, 0.05))


def hook_on_a_moving_parent() -> None:
    stacks.hook()
    parent = link(bpy.data.objects.new("mover", None))
    handle = bpy.data.objects["handle"]
    handle.parent = parent
    insert_keys(parent, "location", (0.0, 0.0, 0.0), (0.0, 0.0, 0.05))


def hook_that_copies_what_moves() -> None:
    stacks.hook()
    mover, handle = link(bpy.data.objects.new("mover", None)), bpy.data.objects["handle"]
    insert_keys(mover, "location", (0.0, 0.0, 0.0), (0.0, 0.0, 0.3))
    handle.constraints.new("COPY_LOCATION").target = mover


def waving_cage() -> None:
    stacks.surface_deform()
    wave = bpy.data.objects["body"].modifiers.new("Wave", "WAVE")
    wave.height, wave.width, wave.narrowness = 0.05, 0.2, 5.0


def keyed_texture() -> None:
    stacks.displace()
    modifier = bpy.data.objects["elbow"].modifiers["Displace"]
    modifier.texture, modifier.strength = bpy.data.textures.new("clouds", "CLOUDS"), 0.05
    insert_keys(modifier.texture, "noise_scale", 0.05, 0.5)


def keyed_nodes() -> None:
    stacks.geometry_nodes()
    group = bpy.data.objects["elbow"].modifiers["Ripple"].node_group
    scale = next(node for node in group.nodes if getattr(node, "operation", "") == "SCALE")
    insert_keys(scale.inputs["Scale"], "default_value", 0.0, 0.05)


def nodes_that_read_a_mover() -> None:
    stacks.geometry_nodes()
    group = bpy.data.objects["elbow"].modifiers["Ripple"].node_group
    mover, info = link(bpy.data.objects.new("mover", None)), group.nodes.new("GeometryNodeObjectInfo")
    info.inputs["Object"].default_value = mover
    group.links.new(info.outputs["Location"], group.nodes["Set Position"].inputs["Offset"])
    insert_keys(mover, "location", (0.0, 0.0, 0.0), (0.0, 0.0, 0.05))


def second_armature_whose_rotation_is_driven() -> None:
    two_armatures()
    bone = bpy.data.objects["muscle_rig"].pose.bones["muscle"]
    bone.driver_add("rotation_euler", 0).driver.expression = "frame / 60"


def keyed_shape() -> None:
    controls.free_shape_keys()
    block = bpy.data.objects["elbow"].data.shape_keys.key_blocks["flexed"]
    insert_keys(block, "value", 0.0, 1.0)


def keyed_shape_of_a_lattice() -> None:
    controls.lattice_shape_key()
    insert_keys(bpy.data.objects["lattice"].data.shape_keys.key_blocks["thick"], "value", 0.0, 1.0)


def keyed_property() -> None:
    controls.modifier_strength()
    insert_keys(bpy.data.objects["elbow"], '["softness"]', 0.0, 1.0)


def second_armature_with_an_action() -> None:
    two_armatures()
    insert_keys(
        bpy.data.objects["muscle_rig"].pose.bones["muscle"], "rotation_euler", (-0.3, 0.0, 0.0), (0.3, 0.0, 0.0)
    )


def one_value_in_all_frames() -> None:
    insert_keys(build_smoothed_tube(), "factor", 0.5, 0.5)


def a_hidden_modifier_with_keys() -> None:
    modifier = build_smoothed_tube()
    insert_keys(modifier, "factor", 0.0, 1.0)
    modifier.show_viewport = False


def a_live_modifier_with_keys() -> None:
    stacks.subdivided()
    insert_keys(bpy.data.objects["elbow"].modifiers["Thickness"], "thickness", 0.0, 0.1)


def what_moves_nothing() -> None:
    modifier, mesh_object = build_smoothed_tube(), bpy.data.objects["elbow"]
    insert_keys(modifier, "show_render", False, True)
    insert_keys(mesh_object, "hide_render", False, True)
    insert_keys(mesh_object, "pass_index", 0, 5)
    mesh_object.driver_add("color", 0).driver.expression = "frame / 30"


def a_muted_shape_with_keys() -> None:
    keyed_shape()
    bpy.data.objects["elbow"].data.shape_keys.key_blocks["flexed"].mute = True


def a_lattice_that_is_carried() -> None:
    """The whole character and its lattice are children of an animated empty."""
    stacks.lattice()
    carrier = link(bpy.data.objects.new("carrier", None))
    for name in ("elbow_rig", "lattice"):
        bpy.data.objects[name].parent = carrier
    insert_keys(carrier, "location", (0.0, 0.0, 0.0), (5.0, 1.0, 0.0))


def bones_that_move_with_time() -> None:
    """Bones that change with time change the pose, which is an input of the model."""
    _, armature_object = tube()
    bone = armature_object.pose.bones["upper"]
    remove_constraints(bone)
    bone.driver_add("rotation_euler", 2).driver.expression = "frame / 60"
    copy = armature_object.pose.bones["lower"].constraints.new("COPY_ROTATION")
    copy.target, copy.subtarget, copy.influence = armature_object, "upper", 0.0
    insert_keys(copy, "influence", 0.0, 1.0)


HARMLESS: tuple[Callable[[], None], ...] = (
    one_value_in_all_frames, a_hidden_modifier_with_keys, a_live_modifier_with_keys, what_moves_nothing,
    a_muted_shape_with_keys, a_lattice_that_is_carried, bones_that_move_with_time,
)  # fmt: skip


def _drive_by_frame(variable_type: str) -> None:
    driver = build_smoothed_tube().driver_add("factor").driver
    variable = driver.variables.new()
    variable.name, variable.type = "current_frame", variable_type
    if variable_type == "SINGLE_PROP":
        variable.targets[0].id_type = "SCENE"
        variable.targets[0].id = bpy.context.scene
    variable.targets[0].data_path = "frame_current"
    driver.expression = "current_frame / 30"
