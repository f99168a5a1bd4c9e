# SPDX-License-Identifier: GPL-3.0-or-later
"""Modifiers that a model cannot replace, and meshes that are only parented to an armature, are refused by name."""

import bpy
import pytest

from blend_fixtures.characters import stacks
from blend_fixtures.characters.base import drive, tube
from fdda_addon.core.errors import RigError
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.rig_check import check_recordable_rig
from fdda_addon.recording.run import record
from fdda_addon.runtime.binding import bind
from fdda_addon.scene.scene_rig import find_rig

from ..conftest import ELBOW, ELBOW_RIG, assert_plays
from ..modifiers import FEW_POSES, add_modifier_at, add_nodes_at, assert_refused, build_rig
from ..scene_state import assert_same_state, drain, scene_state


def simulating(mesh_object: bpy.types.Object) -> None:
    group = stacks.build_node_chain("Group", "GeometryNodeSimulationInput", "GeometryNodeSimulationOutput")
    group.nodes["Simulation Input"].pair_with_output(group.nodes["Simulation Output"])
    stacks.link_geometry_sockets(group)
    add_modifier_at(2, "NODES", node_group=group)(mesh_object)


def in_a_nested_group(mesh_object: bpy.types.Object) -> None:
    inner, outer = stacks.ripple_group(), stacks.build_node_chain("Outer", "GeometryNodeGroup")
    inner.nodes.new("GeometryNodeInputSceneTime")
    outer.nodes["Group"].node_tree = inner
    stacks.link_geometry_sockets(outer)
    add_modifier_at(2, "NODES", node_group=outer)(mesh_object)


def painted(mesh_object: bpy.types.Object) -> None:
    mesh_object.modifiers.new("It", "DYNAMIC_PAINT")
    with bpy.context.temp_override(object=mesh_object, active_object=mesh_object):
        bpy.ops.dpaint.type_toggle(type="CANVAS")
    mesh_object.modifiers["It"].canvas_settings.canvas_surfaces[0].surface_type = "DISPLACE"


def near(mesh_object: bpy.types.Object, vertex_group: str = "near") -> None:
    """Add weights by the distance from a point, before the smoothing."""
    point = bpy.data.objects.new("point", bpy.data.meshes.new("point"))
    point.data.from_pydata([(0, 0, 0)], [], [])
    bpy.context.scene.collection.objects.link(point)
    mesh_object.vertex_groups.new(name="near").add(range(len(mesh_object.data.vertices)), 1.0, "REPLACE")
    add_modifier_at(1, "VERTEX_WEIGHT_PROXIMITY", vertex_group="near", target=point, max_dist=0.4)(mesh_object)
    mesh_object.modifiers["It"].proximity_mode = "GEOMETRY"
    mesh_object.modifiers["It"].proximity_geometry = {"VERTEX"}


def projected(mesh_object: bpy.types.Object) -> None:
    mesh_object.data.uv_layers.new(name="UVMap")
    add_modifier_at(1, "UV_PROJECT", uv_layer="UVMap")(mesh_object)
    mesh_object.modifiers["It"].projectors[0].object = bpy.data.objects[ELBOW_RIG]


def transferred(mesh_object: bpy.types.Object) -> None:
    settings = {"use_vert_data": True, "data_types_verts": {"VGROUP_WEIGHTS"}, "vert_mapping": "NEAREST"}
    source = bpy.data.objects.new("source", mesh_object.data.copy())
    add_modifier_at(1, "DATA_TRANSFER", object=source, use_loop_data=True, **settings)(mesh_object)


def storing(mesh_object: bpy.types.Object, node: str = "GeometryNodeInputPosition") -> None:
    """Add nodes that store the output of a node as the attribute *seen*, before the smoothing."""
    add_nodes_at(1, "GeometryNodeStoreNamedAttribute")(mesh_object)
    group = mesh_object.modifiers["It"].node_group
    store = group.nodes["Store Named Attribute"]
    store.data_type, store.inputs["Name"].default_value = "FLOAT", "seen"
    group.links.new(group.nodes.new(node).outputs[0], store.inputs["Value"])


def seen_by(group: bpy.types.NodeTree, is_text: bool = False) -> bpy.types.NodeSocket:
    """Add a node that reads the attribute *seen*, by its name or by a node String; return its output."""
    attribute, text = group.nodes.new("GeometryNodeInputNamedAttribute"), group.nodes.new("FunctionNodeInputString")
    if is_text:
        text.string = "seen"
        group.links.new(text.outputs[0], attribute.inputs["Name"])
    else:
        attribute.inputs["Name"].default_value = "seen"
    return attribute.outputs[0]


def displace_seen(mesh_object: bpy.types.Object, is_text: bool = False) -> None:
    """Only later nodes, which deform, read the attribute."""
    storing(mesh_object)
    group = stacks.build_node_chain("Displace", "GeometryNodeSetPosition")
    vector = group.nodes.new("ShaderNodeCombineXYZ")
    group.links.new(seen_by(group, is_text), vector.inputs["Z"])
    group.links.new(vector.outputs[0], group.nodes["Set Position"].inputs["Offset"])
    mesh_object.modifiers.new("Displace", "NODES").node_group = group


def store_seen(mesh_object: bpy.types.Object) -> None:
    """Nodes after the rig read the attribute, too."""
    displace_seen(mesh_object)
    group = stacks.build_node_chain("Copy", "GeometryNodeStoreNamedAttribute")
    store = group.nodes["Store Named Attribute"]
    store.data_type, store.inputs["Name"].default_value = "FLOAT", "copy"
    group.links.new(seen_by(group, is_text=True), store.inputs["Value"])
    mesh_object.modifiers.new("Copy", "NODES").node_group = group


POSE = "so its result does not follow from the pose; switch it off in the viewport, or remove it."
MIDDLE = (
    "changes the topology of the mesh before 'Mush', which a model replaces, so its vertices cannot be followed; move "
    "it to the end of the modifiers, switch it off in the viewport, or apply it."
)
ORIGINAL = (
    "changes the topology of the mesh, and Blender lets nothing that plays a model stand before it; switch it off in "
    "the viewport, or apply it."
)
UNBOUND = "is not bound, so it does nothing; bind it first, or switch it off in the viewport."
SHAPE = (
    "depends on the shape of the mesh, and stands between modifiers that a model replaces, so it would see the rest "
    "pose; move it behind 'Mush', or switch it off in the viewport."
)
REFUSED = {
    **{
        kind: (add_modifier_at(1, kind), SHAPE)
        for kind in ("PARTICLE_SYSTEM", "COLLISION", "WEIGHTED_NORMAL", "NORMAL_EDIT")
    },
    **{build.__name__: (build, SHAPE) for build in (near, projected, transferred, storing)},
    "attribute that others read by a text": (store_seen, SHAPE.replace("Mush", "Displace")),
    **{kind: (add_modifier_at(2, kind), f"is a simulation, {POSE}") for kind in ("CLOTH", "SOFT_BODY")},
    **{kind: (add_modifier_at(2, kind), f"plays a cache, {POSE}") for kind in ("MESH_CACHE", "MESH_SEQUENCE_CACHE")},
    **{kind: (add_modifier_at(0, kind), f"changes with time, {POSE}") for kind in ("WAVE", "BUILD")},
    "OCEAN": (add_modifier_at(2, "OCEAN", geometry_mode="DISPLACE", resolution=2), f"changes with time, {POSE}"),
    "EXPLODE": (add_modifier_at(1, "EXPLODE"), f"is a simulation, {POSE}"),
    "FLUID": (add_modifier_at(1, "FLUID", fluid_type="DOMAIN"), f"is a simulation, {POSE}"),
    "DYNAMIC_PAINT": (painted, f"is a simulation, {POSE}"),
    "simulation zone": (simulating, f"changes with time (node 'Simulation Input' of 'Group'), {POSE}"),
    "scene time": (in_a_nested_group, f"changes with time (node 'Scene Time' of 'Ripple'), {POSE}"),
    **{
        f"{kind} at {place}": (add_modifier_at(place, kind), MIDDLE)
        for kind in ("SUBSURF", "MIRROR", "DECIMATE", "SOLIDIFY")
        for place in (0, 1)
    },
    **{f"MULTIRES at {place}": (add_modifier_at(place, "MULTIRES"), ORIGINAL) for place in (0, 2)},
    "subdividing nodes": (add_nodes_at(1, "GeometryNodeSubdivideMesh"), MIDDLE),
    "CORRECTIVE_SMOOTH": (add_modifier_at(2, "CORRECTIVE_SMOOTH", rest_source="BIND"), UNBOUND),
    **{kind: (add_modifier_at(0, kind), UNBOUND) for kind in ("SURFACE_DEFORM", "MESH_DEFORM", "LAPLACIANDEFORM")},
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_unsupported_modifier_is_named_in_the_message(name, loose_model, tmp_path):
    add, sentence = REFUSED[name]
    rig = build_rig(stacks.corrective_smooth)
    add(rig.mesh_object)
    sentence = f"Modifier 'It' of 'elbow' {sentence}"
    assert_refused(rig, loose_model, tmp_path / "recording", sentence)
    rig.mesh_object.modifiers["It"].show_viewport = False
    assert check_recordable_rig(rig).problems == ()
    bind(rig, loose_model)
    assert_plays(rig.mesh_object, loose_model)


def smooth_near(mesh_object: bpy.types.Object) -> None:
    near(mesh_object)
    mesh_object.modifiers["Mush"].vertex_group = "near"


ACCEPTED = {
    "hair before the rig": add_modifier_at(0, "PARTICLE_SYSTEM"),
    "hair after the rig": add_modifier_at(2, "PARTICLE_SYSTEM"),
    "constant weights": add_modifier_at(1, "VERTEX_WEIGHT_EDIT", vertex_group="lower"),
    "weights of the rig": smooth_near,
    "attribute of the rig": displace_seen,
    "attribute of the rig, named by a text": lambda mesh_object: displace_seen(mesh_object, is_text=True),
    "constant attribute": lambda mesh_object: storing(mesh_object, "GeometryNodeInputIndex"),
}


@pytest.mark.parametrize("name", ACCEPTED)
def test_modifiers_without_effect_of_the_shape_are_accepted(name, loose_model):
    rig = build_rig(stacks.corrective_smooth)
    ACCEPTED[name](rig.mesh_object)
    assert check_recordable_rig(rig).problems == ()
    bind(rig, loose_model)
    assert_plays(rig.mesh_object, loose_model)


@pytest.mark.parametrize("in_render", [False, True], ids=["viewport", "render"])
def test_a_modifier_added_while_a_model_plays_is_named(in_render, loose_model):
    rig = build_rig(stacks.corrective_smooth)
    bind(rig, loose_model, use_in_render=in_render)
    assert_plays(rig.mesh_object, loose_model)
    add_modifier_at(1, "PARTICLE_SYSTEM", show_viewport=not in_render)(rig.mesh_object)
    bpy.context.view_layer.update()
    assert rig.mesh_object.fdda.mode == "RIG"
    assert rig.mesh_object.fdda.status == f"Modifier 'It' of 'elbow' {SHAPE.replace('Mush', 'FDDA')}"
    rig.mesh_object.modifiers.move(1, 4)
    rig.mesh_object.fdda.mode = "FDDA"
    assert_plays(rig.mesh_object, loose_model)


def test_geometry_nodes_of_a_hidden_mesh_cannot_be_classified(loose_model):
    rig = build_rig()
    add_nodes_at(1, "GeometryNodeTransform")(rig.mesh_object)
    rig.mesh_object.hide_viewport = True
    with pytest.raises(RigError, match="'elbow' is hidden, so Blender does not evaluate it"):
        bind(rig, loose_model)


def test_a_downstream_modifier_that_a_driver_keeps_enabled_is_named(tmp_path):
    rig = build_rig()
    modifier = rig.mesh_object.modifiers.new("Subdivision", "SUBSURF")
    drive(modifier, "show_viewport", rig.armature_object, "1")
    count = len(rig.mesh_object.data.vertices)
    with pytest.raises(RigError) as error:
        drain(record(rig, tmp_path / "recording", FEW_POSES))
    assert f"The modifiers of 'elbow' turn {count} vertices into " in str(error.value)
    assert str(error.value).endswith("; switch off the one that changes the topology (Subdivision).")


def test_nodes_that_remove_vertices_in_some_poses_are_refused(tmp_path):
    rig = build_rig()
    add_nodes_at(1, "GeometryNodeDeleteGeometry")(rig.mesh_object)
    group = rig.mesh_object.modifiers["It"].node_group
    position, height, above = (
        group.nodes.new(kind) for kind in ("GeometryNodeInputPosition", "ShaderNodeSeparateXYZ", "ShaderNodeMath")
    )
    above.operation, above.inputs[1].default_value = "GREATER_THAN", 0.1
    group.links.new(position.outputs[0], height.inputs[0])
    group.links.new(height.outputs["Z"], above.inputs[0])
    group.links.new(above.outputs[0], group.nodes["Delete Geometry"].inputs["Selection"])
    before = scene_state(rig)
    with pytest.raises(
        RigError,
        match=r"In some pose the modifiers of 'elbow' turn 300 vertices into \d+; look for a modifier that makes or "
        r"removes vertices depending on the pose; switch it off",
    ):
        drain(record(rig, tmp_path / "recording", RecordingSettings(poses=20)))
    assert_same_state(before, scene_state(rig))


def test_an_animated_modifier_that_removes_vertices_is_named(tmp_path):
    rig = build_rig()
    modifiers = rig.mesh_object.modifiers
    modifiers.new("Hide", "MASK").vertex_group = "lower"
    modifiers["Hide"].show_viewport = False
    curve = modifiers["Hide"].driver_add("show_viewport")
    variable = curve.driver.variables.new()
    variable.name, variable.type, variable.targets[0].id = "turn", "TRANSFORMS", rig.armature_object
    variable.targets[0].bone_target, variable.targets[0].transform_type = "lower", "ROT_X"
    variable.targets[0].transform_space = "LOCAL_SPACE"
    curve.driver.expression = "abs(turn) > 0.1"
    with pytest.raises(RigError, match=r"depending on the pose \(animated: 'Hide'\); switch it off"):
        drain(record(rig, tmp_path / "recording", RecordingSettings(poses=20)))


PARENTED = {
    "ARMATURE": "'elbow' is deformed by 'elbow_rig' as its parent, without a modifier; set the type of its parent to "
    "Object and add an Armature modifier with 'elbow_rig'.",
    "BONE": "'elbow' is parented to the bone 'lower' of 'elbow_rig' and moves with it as a whole, so there is nothing "
    "to learn; choose a mesh with an Armature modifier.",
    "OBJECT": "'elbow' is parented to the armature 'elbow_rig', and no modifier deforms it with that; add an Armature "
    "modifier with 'elbow_rig', or choose another mesh.",
}


@pytest.mark.parametrize("kind", PARENTED)
@pytest.mark.parametrize("way", ["the only mesh", "by name", "active", "active armature"])
def test_a_mesh_that_is_only_parented_to_an_armature_is_refused(kind, way):
    from fdda_addon.scene.active_rig import active_rig

    mesh_object, armature_object = tube()
    mesh_object.modifiers.clear()
    mesh_object.parent_type = kind
    if kind == "BONE":
        mesh_object.parent_bone = "lower"
    bpy.context.view_layer.objects.active = armature_object if way == "active armature" else mesh_object
    with pytest.raises(RigError) as error:
        active_rig(bpy.context) if way.startswith("active") else find_rig(ELBOW if way == "by name" else "")
    assert str(error.value) == PARENTED[kind]


def test_a_parented_mesh_does_not_hide_the_rig_of_another_mesh():
    mesh_object, armature_object = tube()
    prop = bpy.data.objects.new("prop", bpy.data.meshes.new("prop"))
    bpy.context.scene.collection.objects.link(prop)
    prop.parent, prop.parent_type, prop.parent_bone = armature_object, "BONE", "lower"
    assert find_rig().mesh_object == mesh_object
    assert bpy.data.objects[ELBOW_RIG] == armature_object
