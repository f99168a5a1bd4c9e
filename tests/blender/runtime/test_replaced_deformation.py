# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes of the deformation that a playing model replaces show the rig with a message; other changes do not."""

from collections.abc import Callable

import bpy
import numpy as np
import pytest

from blend_fixtures.characters.stacks import build_node_chain
from fdda_addon.rig.deformation import read_deformation
from fdda_addon.runtime import playback_modifier
from fdda_addon.runtime.binding import bind
from fdda_addon.scene.compatibility import node_input_settings
from fdda_addon.scene.scene_rig import find_rig

from ..conftest import ELBOW_RIG, assert_plays, evaluated_positions, pose, rig_positions, with_deformation
from ..playback import FRAME, add_shape_key
from ..rig_changes import drive_b_bone, trigger_check


def add(kind: str, place: int | None, **settings: object) -> Callable[[bpy.types.Object], None]:
    """Add a modifier at an index, or at the end for None."""

    def change(mesh_object: bpy.types.Object) -> None:
        modifier = mesh_object.modifiers.new(kind.title(), kind)
        for name, value in settings.items():
            setattr(modifier, name, value)
        if place is not None:
            mesh_object.modifiers.move(len(mesh_object.modifiers) - 1, place)

    return change


def add_key(mesh_object: bpy.types.Object) -> bpy.types.ShapeKey:
    mesh_object.shape_key_add(name="Basis")
    key = mesh_object.shape_key_add(name="bulge")
    for point in key.data:
        point.co.z *= 1.2
    key.value = 0.0
    return key


def key_factor(mesh_object: bpy.types.Object) -> None:
    mesh_object.modifiers["CorrectiveSmooth"].keyframe_insert("factor", frame=1)


def drive_factor(mesh_object: bpy.types.Object) -> None:
    mesh_object.modifiers["CorrectiveSmooth"].driver_add("factor").driver.expression = "frame / 100"


def set_of(modifier: str, **settings: object) -> Callable[[bpy.types.Object], None]:
    def change(mesh_object: bpy.types.Object) -> None:
        for name, value in settings.items():
            setattr(mesh_object.modifiers[modifier], name, value)

    return change


def remove_smooth(mesh_object: bpy.types.Object) -> None:
    mesh_object.modifiers.remove(mesh_object.modifiers["CorrectiveSmooth"])


def bend_segments(_: bpy.types.Object) -> None:
    bpy.data.objects[ELBOW_RIG].data.bones["lower"].bbone_segments = 4


def add_weights(mesh_object: bpy.types.Object) -> None:
    add("VERTEX_WEIGHT_EDIT", 0, vertex_group="lower", use_add=True, add_threshold=0.0)(mesh_object)


GONE = "is gone, switched off or behind the modifier FDDA"

CHANGES = {
    "a subdivision first": (add("SUBSURF", 0, levels=1), "it was recorded without the modifier 'Subsurf'"),
    "a mirror": (add("MIRROR", 1), "it was recorded without the modifier 'Mirror'"),
    "a mask": (add("MASK", 0, vertex_group="lower"), "it was recorded without the modifier 'Mask'"),
    "a decimation": (add("DECIMATE", 0, ratio=0.5), "it was recorded without the modifier 'Decimate'"),
    "a smooth first": (add("SMOOTH", 0, iterations=5), "it was recorded without the modifier 'Smooth'"),
    "other weights": (add_weights, "it was recorded without the modifier 'Vertex_Weight_Edit'"),
    "preserved volume": (
        set_of("Armature", use_deform_preserve_volume=True),
        "'use_deform_preserve_volume' of the modifier 'Armature' was False and is True",
    ),
    "iterations": (
        set_of("CorrectiveSmooth", iterations=3), "'iterations' of the modifier 'CorrectiveSmooth' was 8 and is 3"
    ),
    "a key": (key_factor, "'factor' of the modifier 'CorrectiveSmooth' is animated"),
    "a driver": (drive_factor, "'factor' of the modifier 'CorrectiveSmooth' is animated"),
    "a modifier is gone": (remove_smooth, f"the modifier 'CorrectiveSmooth' {GONE}"),
    "the order": (lambda o: o.modifiers.move(0, 1), "the modifiers are in another order"),
    "the model first": (lambda o: o.modifiers.move(2, 0), f"the modifier 'Armature' {GONE}"),
    "segments": (bend_segments, "the bone 'lower' was no B-Bone when it was recorded"),
    "a shape key": (lambda o: setattr(add_key(o), "value", 1.0), "it was recorded without the shape key 'bulge'"),
}  # fmt: skip


def assert_shows_rig(mesh_object: bpy.types.Object, clause: str) -> np.ndarray:
    """Assert that the rig is shown as without a bound model, and that the status gives the reason."""
    assert clause in mesh_object.fdda.status and mesh_object.fdda.mode == "RIG"
    shown = evaluated_positions(mesh_object)
    modifier = playback_modifier.find_modifier(mesh_object)
    if modifier is not None:
        mesh_object.modifiers.remove(modifier)
    assert np.array_equal(evaluated_positions(mesh_object), shown)
    return shown


@pytest.mark.parametrize("when", ["view layer", "frame"])
@pytest.mark.parametrize("what", CHANGES)
def test_a_change_of_the_replaced_deformation_shows_the_rig(bound_elbow, what, when):
    change, clause = CHANGES[what]
    pose(angle=1.0)
    change(bound_elbow)
    trigger_check(when)
    assert_shows_rig(bound_elbow, clause)


def test_a_render_only_topology_change_shows_the_rig(bound_elbow):
    """A model that is also used in renders would be applied to another topology there."""
    bound_elbow.fdda.use_in_render = True
    add("SUBSURF", 0, show_viewport=False)(bound_elbow)
    trigger_check("view layer")
    assert_shows_rig(bound_elbow, "it was recorded without the modifier 'Subsurf'")


ALLOWED = {
    "a subdivision at the end": add("SUBSURF", None, levels=1),
    "a smooth at the end": add("SMOOTH", None, iterations=5),
    "one that is off": add("SMOOTH", 0, show_viewport=False),
    "a replaced one is shown": set_of("CorrectiveSmooth", show_viewport=True),
    "another name": set_of("CorrectiveSmooth", name="Mush"),
    "a shape key that does nothing yet": add_key,
    "shading": add("WEIGHTED_NORMAL", 0),
}


@pytest.mark.parametrize("what", ALLOWED)
def test_playback_continues_after_an_unrelated_change(bound_elbow, elbow_files, what):
    pose(angle=1.0)
    playing = evaluated_positions(bound_elbow)
    ALLOWED[what](bound_elbow)
    pose(angle=1.0)
    assert bound_elbow.fdda.mode == "FDDA" and not bound_elbow.fdda.status
    for modifier in bound_elbow.modifiers:
        if bound_elbow.modifiers.find(modifier.name) > bound_elbow.modifiers.find("FDDA"):
            modifier.show_viewport = False
    assert np.abs(assert_plays(bound_elbow, elbow_files.model) - playing).max() < 1e-6
    # The rig differs from the model as little as before the change.
    assert np.abs(rig_positions(bound_elbow) - playing).max() < 5e-3


def test_playback_resumes_after_the_change_is_undone(bound_elbow, elbow_files):
    pose(angle=1.0)
    add("SMOOTH", 0)(bound_elbow)
    trigger_check("view layer")
    assert bound_elbow.fdda.mode == "RIG"
    bound_elbow.modifiers.remove(bound_elbow.modifiers["Smooth"])
    bound_elbow.fdda.mode = "FDDA"
    pose(angle=0.8)
    assert_plays(bound_elbow, elbow_files.model)


def test_binding_again_keeps_modifiers_after_the_playback_modifier(bound_elbow, elbow_files):
    """Deforming modifiers after the playback modifier are not replaced and keep their position."""
    add("SMOOTH", None, iterations=5)(bound_elbow)
    bind(find_rig(), elbow_files.model)
    bpy.context.view_layer.update()
    names = ["Armature", "CorrectiveSmooth", "FDDA", "FDDA Undeformed", "Smooth"]
    assert [m.name for m in bound_elbow.modifiers] == names
    assert not bound_elbow.fdda.status
    bound_elbow.modifiers["Smooth"].show_viewport = False
    pose(angle=1.0)
    assert_plays(bound_elbow, elbow_files.model)


def drive_key(mesh_object: bpy.types.Object) -> bpy.types.Driver:
    """Add a driver by which the lower bone sets a shape key, as for a biceps."""
    driver = add_key(mesh_object).driver_add("value").driver
    variable = driver.variables.new()
    variable.type = "TRANSFORMS"
    variable.targets[0].id, variable.targets[0].bone_target = bpy.data.objects[ELBOW_RIG], "lower"
    variable.targets[0].transform_type = "ROT_X"
    driver.type = "SUM"
    return driver


def bulge_of(mesh_object: bpy.types.Object) -> bpy.types.ShapeKey:
    return mesh_object.data.shape_keys.key_blocks["bulge"]


def sculpt(mesh_object: bpy.types.Object) -> None:
    bulge_of(mesh_object).data[7].co.z += 0.05


def make_relative(mesh_object: bpy.types.Object) -> None:
    bulge_of(mesh_object).relative_key = mesh_object.shape_key_add(name="other", from_mix=False)


KEY = "shape key 'bulge'"

KEY_CHANGES = {
    "another shape": (sculpt, f"'shape' of the {KEY} differs"),
    "a muted key": (lambda o: setattr(bulge_of(o), "mute", True), f"'mute' of the {KEY}"),
    "no key": (lambda o: o.shape_key_remove(bulge_of(o)), f"the {KEY} is gone"),
    "another name": (lambda o: setattr(bulge_of(o), "name", "swell"), f"the {KEY} is gone"),
    "a vertex group": (lambda o: setattr(bulge_of(o), "vertex_group", "upper"), f"'vertex_group' of the {KEY}"),
    "another relative key": (make_relative, f"'relative_key' of the {KEY} was Basis and is other"),
    "absolute keys": (lambda o: setattr(o.data.shape_keys, "use_relative", False), f"'use_relative' of the {KEY}"),
    "one key alone": (lambda o: setattr(o, "show_only_shape_key", True), f"'show_only_shape_key' of the {KEY}"),
}


@pytest.mark.parametrize("what", KEY_CHANGES)
def test_a_change_of_a_recorded_shape_key_shows_the_rig(rig, elbow_files, what):
    drive_key(rig.mesh_object)
    bpy.context.view_layer.update()
    bind(rig, with_deformation(elbow_files.model, read_deformation(rig)))
    for angle in (0.5, 1.0):
        pose(angle=angle)
    assert rig.mesh_object.fdda.mode == "FDDA" and not rig.mesh_object.fdda.status
    change, clause = KEY_CHANGES[what]
    change(rig.mesh_object)
    trigger_check("view layer")
    assert_shows_rig(rig.mesh_object, clause)


SOCKETS = {"Float": -1, "Vector": 2, "Int": -1, "Bool": -1}
"""Types of sockets of Geometry Nodes, each with the index of the element that is animated."""


def add_nodes(mesh_object: bpy.types.Object, socket_type: str = "Float") -> tuple[bpy.types.Modifier, str]:
    """Add Geometry Nodes that move vertices by an input; return the modifier, and the identifier of the input."""
    group = build_node_chain("Group", "GeometryNodeSetPosition")
    socket = group.interface.new_socket("Amount", in_out="INPUT", socket_type=f"NodeSocket{socket_type}")
    input_node, position_node = group.nodes[:2]
    group.links.new(input_node.outputs["Amount"], position_node.inputs["Offset"])
    modifier = mesh_object.modifiers.new("GN", "NODES")
    modifier.node_group = group
    return modifier, socket.identifier


def path_of_input(modifier: bpy.types.Modifier, identifier: str) -> str:
    return node_input_settings(modifier)[identifier][0]


def set_attribute(modifier: bpy.types.Modifier, identifier: str, name: str) -> None:
    """Make an input read an attribute, or its value for an empty name."""
    if hasattr(modifier, "properties") and hasattr(modifier.properties, "inputs"):
        socket = getattr(modifier.properties.inputs, identifier)
        socket.type, socket.attribute_name = "ATTRIBUTE" if name else "VALUE", name
    else:
        modifier[f"{identifier}_use_attribute"], modifier[f"{identifier}_attribute_name"] = bool(name), name
    modifier.id_data.update_tag()


@pytest.mark.parametrize("socket_type", SOCKETS)
def test_a_driven_input_of_nodes_plays_in_every_pose(rig, elbow_files, socket_type):
    modifier, identifier = add_nodes(rig.mesh_object, socket_type)
    driver = rig.mesh_object.driver_add(path_of_input(modifier, identifier), SOCKETS[socket_type]).driver
    variable = driver.variables.new()
    variable.type, variable.targets[0].id = "TRANSFORMS", rig.armature_object
    variable.targets[0].bone_target, variable.targets[0].transform_type = "lower", "ROT_X"
    driver.type = "SUM"
    bpy.context.view_layer.update()
    model = with_deformation(elbow_files.model, read_deformation(rig))
    for angle in (1.2, 0.5):
        pose(angle=angle)
        bind(rig, model)
        trigger_check("view layer")
        assert rig.mesh_object.fdda.mode == "FDDA" and not rig.mesh_object.fdda.status
    driver.type = "AVERAGE"
    rig.mesh_object.update_tag()
    trigger_check("view layer")
    assert_shows_rig(rig.mesh_object, 'the driver of \'modifiers["GN"]["Socket_2"]\' differs')


def set_values(mesh_object: bpy.types.Object, name: str) -> None:
    mesh_object.data.attributes[name].data.foreach_set("value", [0.03] * len(mesh_object.data.vertices))


READS, LAYER = "'Socket_2_attribute' of the modifier 'GN' was mask and is", "the attribute or vertex group"

ATTRIBUTES = {
    "its value": (lambda o, m, i: set_attribute(m, i, ""), f"{READS} empty"),
    "another": (lambda o, m, i: set_attribute(m, i, "other"), f"{READS} other"),
    "another name": (lambda o, m, i: setattr(o.data.attributes["mask"], "name", "other"), f"{LAYER} 'mask' is gone"),
    "other values": (lambda o, m, i: set_values(o, "mask"), f"'values' of {LAYER} 'mask' differs"),
    "no attribute": (lambda o, m, i: o.data.attributes.remove(o.data.attributes["mask"]), f"{LAYER} 'mask' is gone"),
    "in a node": (
        lambda o, m, i: o.vertex_groups["inner"].add([3], 0.5, "ADD"),
        f"'values' of {LAYER} 'inner' differs",
    ),
}


@pytest.mark.parametrize("what", ATTRIBUTES)
def test_another_attribute_that_nodes_read_shows_the_rig(rig, elbow_files, what):
    mesh_object = rig.mesh_object
    modifier, identifier = add_nodes(mesh_object)
    node = modifier.node_group.nodes.new("GeometryNodeInputNamedAttribute")
    node.inputs["Name"].default_value = mesh_object.vertex_groups.new(name="inner").name
    mesh_object.data.attributes.new("mask", "FLOAT", "POINT")
    set_attribute(modifier, identifier, "mask")
    bpy.context.view_layer.update()
    bind(rig, with_deformation(elbow_files.model, read_deformation(rig)))
    pose(angle=1.0)
    assert mesh_object.fdda.mode == "FDDA" and not mesh_object.fdda.status
    change, clause = ATTRIBUTES[what]
    change(mesh_object, modifier, identifier)
    # The interface tags the mesh too.
    mesh_object.data.update()
    trigger_check("view layer")
    assert_shows_rig(mesh_object, clause)


def test_a_copied_character_with_copied_drivers_plays(rig, elbow_files):
    """Names of objects are not compared."""
    drive_key(rig.mesh_object)
    bpy.context.view_layer.update()
    bind(rig, with_deformation(elbow_files.model, read_deformation(rig)))
    mesh_object, armature_object = rig.mesh_object.copy(), rig.armature_object.copy()
    mesh_object.data = mesh_object.data.copy()
    for copy in (mesh_object, armature_object):
        bpy.context.scene.collection.objects.link(copy)
    mesh_object.modifiers["Armature"].object = mesh_object.parent = armature_object
    mesh_object.data.shape_keys.animation_data.drivers[0].driver.variables[0].targets[0].id = armature_object
    pose(angle=0.7)
    pose(armature_object.name, 0.4)
    assert not mesh_object.fdda.status and mesh_object.fdda.mode == "FDDA"


def test_a_driven_setting_of_a_b_bone_follows_the_pose(rig, elbow_files):
    """Rigify drives the easing of its B-Bones: the value in the file is that of the last pose."""
    bone = rig.armature_object.data.bones["lower"]
    bone.bbone_segments = 4
    drive_b_bone()
    bind(rig, with_deformation(elbow_files.model, read_deformation(rig)))
    before = bone.bbone_easein
    bpy.context.scene.frame_set(FRAME)
    assert abs(bone.bbone_easein - before) > 0.1
    bone.bbone_easeout = 1.0  # as before, but the armature is checked
    trigger_check("view layer")
    assert rig.mesh_object.fdda.mode == "FDDA" and not rig.mesh_object.fdda.status
    bone.bbone_easeout = 0.5
    trigger_check("view layer")
    assert_shows_rig(rig.mesh_object, "'easeout' of the bone 'lower' was 1.0 and is 0.5")


def test_shape_keys_are_restored_with_the_rig(bound_elbow, elbow_files):
    add_shape_key(bound_elbow)
    pose(angle=1.1)
    assert_plays(bound_elbow, elbow_files.model)
    shown = rig_positions(bound_elbow)
    bound_elbow.data.shape_keys.key_blocks["bulge"].value = 0
    bpy.context.view_layer.update()
    assert_plays(bound_elbow, elbow_files.model)
    assert np.abs(rig_positions(bound_elbow) - shown).max() > 1e-3
    assert not bound_elbow.show_only_shape_key and not any(key.mute for key in bound_elbow.data.shape_keys.key_blocks)


def test_shape_keys_are_not_mixed_while_a_model_plays(bound_elbow):
    add_shape_key(bound_elbow)
    bulge = bound_elbow.data.shape_keys.key_blocks["bulge"]

    def muted() -> list[bool]:
        keys = bound_elbow.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.shape_keys
        return [key.mute for key in keys.key_blocks]

    for angle, value in ((0.4, 1.0), (0.8, 1.0), (0.8, 0.5), (1.2, 0.5)):
        bulge.value = value
        pose(angle=angle)
        # What was set has been copied anew.
        pose(angle=angle + 0.01)
        assert muted() == [True] * len(bound_elbow.data.shape_keys.key_blocks)
    bound_elbow.fdda.mode = "RIG"
    bpy.context.view_layer.update()
    bulge.value = 1.0
    bpy.context.view_layer.update()
    assert not any(muted())


def test_an_undeformed_shape_key_added_during_playback_is_muted(bound_elbow, elbow_files):
    pose(angle=0.3)
    assert_plays(bound_elbow, elbow_files.model)
    bound_elbow.shape_key_add(name="Basis")
    # A new key displaces no vertex, so the model still plays.
    bound_elbow.shape_key_add(name="bulge").value = 1
    for angle in (0.5, 0.7, 0.9):
        pose(angle=angle)
    keys = bound_elbow.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.shape_keys
    assert [key.mute for key in keys.key_blocks] == [True, True]
    assert_plays(bound_elbow, elbow_files.model)


def test_shape_keys_of_two_objects(bound_elbow, elbow_files):
    """Two objects share a mesh: one plays the model and the other shows the rig."""
    add_shape_key(bound_elbow)
    pose(angle=0.9)
    expected = rig_positions(bound_elbow)
    other = bound_elbow.copy()
    bpy.context.scene.collection.objects.link(other)
    other.fdda.mode = "RIG"
    for angle in (1.4, 0.9):
        pose(angle=angle)
    assert np.abs(evaluated_positions(other) - expected).max() < 1e-6
    assert_plays(bound_elbow, elbow_files.model)
