# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters in which something depends on time: one function each, which builds it in the current scene.

Of `REFUSED` the surface changes with the frame and no model could be told. Of `TOLD` what is keyed is a control. Of
`HARMLESS` the surface follows from the pose, whatever is keyed.
"""

from collections.abc import Callable

import bpy

from . import controls, stacks
from .base import bulge, link, tube
from .bones import free
from .controls import add_key, add_property, follow
from .skinning import two_armatures


def key(owner: bpy.types.bpy_struct, path: str, first: object, last: object) -> None:
    """Key a property at frames 1 and 30, and go to frame 1."""
    for frame, value in ((1, first), (30, last)):
        if path.startswith('["'):
            owner[path[2:-2]] = value
        else:
            setattr(owner, path, value)
        owner.keyframe_insert(path, frame=frame)
    bpy.context.scene.frame_set(1)


def smooth() -> bpy.types.Modifier:
    """Build a tube that is smoothed after the skinning; gives the modifier."""
    stacks.smooth()
    return bpy.data.objects["elbow"].modifiers["Smooth"]


def keyed_strength() -> None:
    key(smooth(), "factor", 0.0, 1.0)


def strength_in_the_nla() -> None:
    key(smooth(), "factor", 0.0, 1.0)
    animation = bpy.data.objects["elbow"].animation_data
    action, slot = animation.action, animation.action_slot
    animation.action = None
    strip = animation.nla_tracks.new().strips.new("strip", 1, action)
    strip.action_slot = slot


def driven_by_frame() -> None:
    smooth().driver_add("factor").driver.expression = "min(1, frame / 30)"


def driven_by_the_scene() -> None:
    _reads_frame("SINGLE_PROP")


def driven_by_the_context() -> None:
    _reads_frame("CONTEXT_PROP")


def through_a_property() -> None:
    """The strength follows a property of the mesh, which follows the frame."""
    modifier, mesh_object = smooth(), bpy.data.objects["elbow"]
    add_property(mesh_object, "softness")
    follow(modifier, "factor", mesh_object, '["softness"]')
    mesh_object.driver_add('["softness"]').driver.expression = "min(1, frame / 30)"


def keyed_property_without_a_range() -> None:
    modifier, armature_object = smooth(), bpy.data.objects["elbow_rig"]
    armature_object["soft"] = 0.0
    follow(modifier, "factor", armature_object, '["soft"]')
    key(armature_object, '["soft"]', 0.0, 1.0)


def property_of_the_scene() -> None:
    modifier, scene = smooth(), bpy.context.scene
    scene["soft"] = 0.0
    driver = modifier.driver_add("factor").driver
    variable = driver.variables.new()
    variable.name, variable.targets[0].id_type = "soft", "SCENE"
    variable.targets[0].id, variable.targets[0].data_path = scene, '["soft"]'
    driver.expression = "soft"
    key(scene, '["soft"]', 0.0, 1.0)


def shape_driven_by_frame() -> None:
    mesh_object, _ = tube()
    add_key(mesh_object, "flexed", bulge).driver_add("value").driver.expression = "min(1, frame / 30)"


def keyed_evaluation_time() -> None:
    stacks.absolute_shape_keys()
    keys = bpy.data.objects["elbow"].data.shape_keys
    keys.driver_remove("eval_time")
    key(keys, "eval_time", 0.0, 10.0)


def keyed_lattice() -> None:
    stacks.lattice()
    key(bpy.data.objects["lattice"], "location", (0.25, 0.0, 0.0), (0.25, 0.0, 0.05))


def hook_on_a_moving_parent() -> None:
    stacks.hook()
    parent = link(bpy.data.objects.new("mover", None))
    handle = bpy.data.objects["handle"]
    handle.parent = parent
    key(parent, "location", (0.0, 0.0, 0.0), (0.0, 0.0, 0.05))


def hook_that_copies_what_moves() -> None:
    stacks.hook()
    mover, handle = link(bpy.data.objects.new("mover", None)), bpy.data.objects["handle"]
    key(mover, "location", (0.0, 0.0, 0.0), (0.0, 0.0, 0.3))
    handle.constraints.new("COPY_LOCATION").target = mover


def waving_cage() -> None:
    stacks.surface_deform()
    wave = bpy.data.objects["body"].modifiers.new("Wave", "WAVE")
    wave.height, wave.width, wave.narrowness = 0.05, 0.2, 5.0


def keyed_texture() -> None:
    stacks.displace()
    modifier = bpy.data.objects["elbow"].modifiers["Displace"]
    modifier.texture, modifier.strength = bpy.data.textures.new("clouds", "CLOUDS"), 0.05
    key(modifier.texture, "noise_scale", 0.05, 0.5)


def keyed_nodes() -> None:
    stacks.geometry_nodes()
    group = bpy.data.objects["elbow"].modifiers["Ripple"].node_group
    scale = next(node for node in group.nodes if getattr(node, "operation", "") == "SCALE")
    key(scale.inputs["Scale"], "default_value", 0.0, 0.05)


def nodes_that_read_a_mover() -> None:
    stacks.geometry_nodes()
    group = bpy.data.objects["elbow"].modifiers["Ripple"].node_group
    mover, info = link(bpy.data.objects.new("mover", None)), group.nodes.new("GeometryNodeObjectInfo")
    info.inputs["Object"].default_value = mover
    group.links.new(info.outputs["Location"], group.nodes["Set Position"].inputs["Offset"])
    key(mover, "location", (0.0, 0.0, 0.0), (0.0, 0.0, 0.05))


def second_armature_whose_rotation_is_driven() -> None:
    two_armatures()
    bone = bpy.data.objects["muscle_rig"].pose.bones["muscle"]
    bone.driver_add("rotation_euler", 0).driver.expression = "frame / 60"


def keyed_shape() -> None:
    controls.free_shape_keys()
    block = bpy.data.objects["elbow"].data.shape_keys.key_blocks["flexed"]
    key(block, "value", 0.0, 1.0)


def keyed_shape_of_a_lattice() -> None:
    controls.lattice_shape_key()
    key(bpy.data.objects["lattice"].data.shape_keys.key_blocks["thick"], "value", 0.0, 1.0)


def keyed_property() -> None:
    controls.modifier_strength()
    key(bpy.data.objects["elbow"], '["softness"]', 0.0, 1.0)


def second_armature_with_an_action() -> None:
    two_armatures()
    key(bpy.data.objects["muscle_rig"].pose.bones["muscle"], "rotation_euler", (-0.3, 0.0, 0.0), (0.3, 0.0, 0.0))


def one_value_in_all_frames() -> None:
    key(smooth(), "factor", 0.5, 0.5)


def a_hidden_modifier_with_keys() -> None:
    modifier = smooth()
    key(modifier, "factor", 0.0, 1.0)
    modifier.show_viewport = False


def a_live_modifier_with_keys() -> None:
    stacks.subdivided()
    key(bpy.data.objects["elbow"].modifiers["Thickness"], "thickness", 0.0, 0.1)


def what_moves_nothing() -> None:
    modifier, mesh_object = smooth(), bpy.data.objects["elbow"]
    key(modifier, "show_render", False, True)
    key(mesh_object, "hide_render", False, True)
    key(mesh_object, "pass_index", 0, 5)
    mesh_object.driver_add("color", 0).driver.expression = "frame / 30"


def a_muted_shape_with_keys() -> None:
    keyed_shape()
    bpy.data.objects["elbow"].data.shape_keys.key_blocks["flexed"].mute = True


def a_lattice_that_is_carried() -> None:
    """The whole character, its lattice with it, follows an empty that is animated."""
    stacks.lattice()
    carrier = link(bpy.data.objects.new("carrier", None))
    for name in ("elbow_rig", "lattice"):
        bpy.data.objects[name].parent = carrier
    key(carrier, "location", (0.0, 0.0, 0.0), (5.0, 1.0, 0.0))


def bones_that_move_with_time() -> None:
    """What depends on time in the armature itself is the pose, which a model is told."""
    _, armature_object = tube()
    bone = armature_object.pose.bones["upper"]
    free(bone)
    bone.driver_add("rotation_euler", 2).driver.expression = "frame / 60"
    copy = armature_object.pose.bones["lower"].constraints.new("COPY_ROTATION")
    copy.target, copy.subtarget, copy.influence = armature_object, "upper", 0.0
    key(copy, "influence", 0.0, 1.0)


REFUSED: tuple[Callable[[], None], ...] = (
    keyed_strength, strength_in_the_nla, driven_by_frame, driven_by_the_scene, driven_by_the_context,
    through_a_property, keyed_property_without_a_range, property_of_the_scene, shape_driven_by_frame,
    keyed_evaluation_time, keyed_lattice, hook_on_a_moving_parent, hook_that_copies_what_moves, waving_cage,
    keyed_texture, keyed_nodes, nodes_that_read_a_mover, second_armature_whose_rotation_is_driven,
)  # fmt: skip
TOLD: tuple[Callable[[], None], ...] = (
    keyed_shape, keyed_shape_of_a_lattice, keyed_property, second_armature_with_an_action,
)  # fmt: skip
HARMLESS: tuple[Callable[[], None], ...] = (
    one_value_in_all_frames, a_hidden_modifier_with_keys, a_live_modifier_with_keys, what_moves_nothing,
    a_muted_shape_with_keys, a_lattice_that_is_carried, bones_that_move_with_time,
)  # fmt: skip


def _reads_frame(variable_type: str) -> None:
    driver = smooth().driver_add("factor").driver
    variable = driver.variables.new()
    variable.name, variable.type = "now", variable_type
    if variable_type == "SINGLE_PROP":
        variable.targets[0].id_type = "SCENE"
        variable.targets[0].id = bpy.context.scene
    variable.targets[0].data_path = "frame_current"
    driver.expression = "now / 30"
