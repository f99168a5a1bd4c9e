# SPDX-License-Identifier: GPL-3.0-or-later
"""Deforming modifiers are recorded and replaced by the model, or refused by name; later ones stay enabled."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import stacks
from blend_fixtures.characters.base import drive, tube
from fdda_addon.core.errors import RigError
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.skinned import skin_recording
from fdda_addon.evaluation.run import evaluate
from fdda_addon.evaluation.settings import EvaluationSettings
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.rig_check import check_recordable_rig
from fdda_addon.recording.run import record
from fdda_addon.rig.modifier_stack import ModifierStack, read_stack
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.scene.scene_rig import SceneRig, find_rig
from fdda_addon.timing import benchmark

from ..conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, pose
from ..modifiers import FEW_POSES, add_modifier_at, add_nodes_at, assert_refused, build_rig
from ..scene_state import assert_same_state, drain, scene_state

MOVES = 0.001
"""Smallest distance of the farthest vertex from linear skinning with any of the stacks, meters."""


def residuals(rig: SceneRig, folder: Path) -> np.ndarray:
    drain(record(rig, folder / "recording", FEW_POSES))
    skinned = skin_recording(read_recording(folder / "recording"))
    return skinned.compute_residuals(np.arange(len(skinned.rows)))


def shown(rig: SceneRig) -> list[tuple]:
    return [(m.name, m.show_viewport, m.show_render) for m in rig.mesh_object.modifiers]


@pytest.mark.parametrize("build", stacks.STACKS, ids=lambda build: build.__name__)
def test_a_deforming_stack_is_recorded_and_played(build, loose_model, tmp_path):
    rig = build_rig(build)
    assert check_recordable_rig(rig).problems == ()
    before, modifiers = scene_state(rig), shown(rig)
    assert np.linalg.norm(residuals(rig, tmp_path), axis=2).max() > MOVES
    assert_same_state(before, scene_state(rig))

    pose(angle=1.0)
    true = evaluated_positions(rig.mesh_object)
    bind(rig, loose_model)
    live = [m for m in rig.mesh_object.modifiers if m.name in read_downstream_names(rig)]
    assert len(evaluated_positions(rig.mesh_object)) == len(true)
    for modifier in live:
        modifier.show_viewport = False
    for mode in ("FDDA", "LINEAR"):
        rig.mesh_object.fdda.mode = mode
        assert len(evaluated_positions(rig.mesh_object)) == len(rig.mesh_object.data.vertices)
    rig.mesh_object.fdda.mode = "FDDA"
    assert_plays(rig.mesh_object, loose_model)
    for modifier in live:
        modifier.show_viewport = True
    unbind(rig.mesh_object)
    assert shown(rig) == modifiers
    np.testing.assert_allclose(evaluated_positions(rig.mesh_object), true, atol=1e-6)


def read_downstream_names(rig: SceneRig) -> tuple[str, ...]:
    """Return the names of the modifiers that stay on after the modifier FDDA of a bound object."""
    with_rig, rig.mesh_object.fdda.mode = rig.mesh_object.fdda.mode, "RIG"
    live = read_stack(rig.mesh_object).downstream
    rig.mesh_object.fdda.mode = with_rig
    return live


def test_modifiers_that_add_vertices_after_the_rig_use_the_output_of_the_model(loose_model):
    rig = build_rig(stacks.subdivided)
    assert read_stack(rig.mesh_object) == ModifierStack(
        ("Armature", "Mush"), (), ("Subdivision", "Thickness", "Detail"), 2
    )
    pose(angle=1.0)
    true = evaluated_positions(rig.mesh_object)
    bind(rig, loose_model)
    playing = evaluated_positions(rig.mesh_object)
    assert len(playing) == len(true) > 8 * len(rig.mesh_object.data.vertices)
    # The smoothing of this character differs slightly from the smoothing that the model has learned.
    assert np.linalg.norm(playing - true, axis=1).mean() < 0.002
    assert [m.name for m in rig.mesh_object.modifiers if m.show_viewport] == [
        "FDDA", "FDDA Undeformed", "Subdivision", "Thickness", "Detail",
    ]  # fmt: skip


def test_an_evaluation_disables_downstream_modifiers_and_restores_them(rig, elbow_files):
    settings = EvaluationSettings(poses=3, range_scales=())
    errors = drain(evaluate(rig, elbow_files.model, settings)).fdda
    rig.mesh_object.modifiers.new("Subdivision", "SUBSURF")
    before = scene_state(rig)
    assert drain(evaluate(rig, elbow_files.model, settings)).fdda == errors
    assert_same_state(before, scene_state(rig))


@pytest.mark.parametrize("is_trained", [True, False])
def test_frame_times_include_downstream_modifiers(rig, elbow_files, monkeypatch, is_trained):
    rig.mesh_object.modifiers.new("Subdivision", "SUBSURF")
    before = scene_state(rig)
    seen, time_frames = [], benchmark.time_frames

    def watch(scene: bpy.types.Scene, *arguments: object) -> list[float]:
        is_shown = scene == bpy.context.scene
        seen.append([m.name for m in rig.mesh_object.modifiers if m.show_viewport] if is_shown else None)
        return time_frames(scene, *arguments)

    monkeypatch.setattr(benchmark, "time_frames", watch)
    models = {rig.mesh_object: elbow_files.model} if is_trained else {}
    assert drain(benchmark.benchmark(rig.armature_object, 5, models)).is_estimate != is_trained
    true, linear, model = (
        [*own, "Subdivision"] for own in (["Armature", "CorrectiveSmooth"], ["Armature"], ["FDDA", "FDDA Undeformed"])
    )
    # More rounds follow while the times vary.
    rounds = len(seen) // 5
    assert seen == [true, linear, model, None, None] * rounds
    assert benchmark.ROUNDS <= rounds <= benchmark.MAX_ROUNDS
    assert_same_state(before, scene_state(rig))


def test_modifiers_that_do_not_deform_are_ignored_at_any_position(loose_model, tmp_path):
    rig = build_rig(stacks.corrective_smooth)
    plain = residuals(rig, tmp_path)
    first = ("UV_WARP", "VERTEX_WEIGHT_EDIT", "DATA_TRANSFER")
    for kind in ("WEIGHTED_NORMAL", "TRIANGULATE", "PARTICLE_SYSTEM", "FLUID", "COLLISION", *first):
        rig.mesh_object.modifiers.new(kind, kind)
    for place in range(len(first)):
        rig.mesh_object.modifiers.move(len(rig.mesh_object.modifiers) - 1, place)
    (tmp_path / "again").mkdir()
    assert read_stack(rig.mesh_object).replaced == ("Armature", "Mush")
    np.testing.assert_allclose(residuals(rig, tmp_path / "again"), plain, atol=1e-6)
    bind(rig, loose_model)
    assert {m.name for m in rig.mesh_object.modifiers if not m.show_viewport} == {"Armature", "Mush"}
    assert_plays(rig.mesh_object, loose_model)


def test_a_render_only_modifier_between_replaced_ones_is_disabled_while_a_model_renders(loose_model):
    rig = build_rig(stacks.corrective_smooth)
    rig.mesh_object.modifiers.new("Subdivision", "SUBSURF").show_viewport = False
    rig.mesh_object.modifiers.move(2, 1)
    before = shown(rig)
    bind(rig, loose_model, use_in_render=True)
    assert not rig.mesh_object.modifiers["Subdivision"].show_render
    rig.mesh_object.fdda.mode = "RIG"
    assert [state for state in shown(rig) if not state[0].startswith("FDDA")] == before


def test_a_disabled_modifier_does_not_move_the_playback_modifier(loose_model):
    rig = build_rig(stacks.subdivided)
    rig.mesh_object.modifiers.new("Cast", "CAST").show_viewport = False
    bind(rig, loose_model)
    assert rig.mesh_object.modifiers.find("FDDA") == 2


def test_the_playback_modifier_is_inserted_before_a_modifier_pinned_to_last(loose_model):
    rig = build_rig(stacks.corrective_smooth)
    last = rig.mesh_object.modifiers.new("Subdivision", "SUBSURF")
    last.use_pin_to_last = True
    bind(rig, loose_model)
    assert [m.name for m in rig.mesh_object.modifiers] == ["Armature", "Mush", "FDDA", "FDDA Undeformed", "Subdivision"]


@pytest.mark.parametrize("kind", ["BUILD", "EXPLODE", "PARTICLE_INSTANCE"])
def test_time_dependent_modifiers_that_add_vertices_after_the_rig_are_downstream(kind):
    rig = build_rig(stacks.corrective_smooth)
    add_modifier_at(2, kind)(rig.mesh_object)
    assert read_stack(rig.mesh_object).downstream == ("It",)
    assert check_recordable_rig(rig).problems == ()


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        ((), "neutral"),
        (("GeometryNodeSetShadeSmooth", "GeometryNodeStoreNamedAttribute"), "neutral"),
        (("GeometryNodeSetPosition", "GeometryNodeSetMaterial"), "replaced"),
        (("GeometryNodeTransform",), "replaced"),
        (("GeometryNodeJoinGeometry",), "replaced"),
        (("GeometryNodeTriangulate",), "live"),
        (("GeometryNodeSubdivideMesh",), "live"),
        (("GeometryNodeFlipFaces",), "live"),
        (("GeometryNodeMeshToPoints",), "live"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else value,
)
@pytest.mark.parametrize("after", ["", "SUBSURF"])
def test_geometry_nodes_are_classified_by_their_effect(kinds, expected, after):
    rig = build_rig(stacks.corrective_smooth)
    add_nodes_at(2, *kinds)(rig.mesh_object)
    if after:
        rig.mesh_object.modifiers.new("After", after)
    before = scene_state(rig)
    stack = read_stack(rig.mesh_object)
    assert stack.replaced == ("Armature", "Mush") + (("It",) if expected == "replaced" else ())
    assert stack.downstream == (("It",) if expected == "live" else ()) + (("After",) if after else ())
    assert_same_state(before, scene_state(rig))


def test_a_node_group_with_unconnected_geometry_is_downstream():
    rig = build_rig()
    add_nodes_at(1)(rig.mesh_object)
    group = rig.mesh_object.modifiers["It"].node_group
    group.links.clear()
    assert read_stack(rig.mesh_object).downstream == ("It",)


def test_nodes_that_store_the_position_attribute_are_replaced():
    rig = build_rig()
    add_nodes_at(1, "GeometryNodeStoreNamedAttribute")(rig.mesh_object)
    group = rig.mesh_object.modifiers["It"].node_group
    group.nodes["Store Named Attribute"].inputs["Name"].default_value = "position"
    assert read_stack(rig.mesh_object).replaced == ("Armature", "It")


def test_a_simulation_after_the_rig_uses_the_output_of_the_model(loose_model):
    rig = build_rig(stacks.corrective_smooth)
    add_modifier_at(2, "CLOTH", show_viewport=False)(rig.mesh_object)
    bind(rig, loose_model)
    rig.mesh_object.modifiers["It"].show_viewport = True
    for frame in range(1, 5):
        bpy.context.scene.frame_set(frame)
    falling = evaluated_positions(rig.mesh_object)
    rig.mesh_object.modifiers["It"].show_viewport = False
    moved = falling - assert_plays(rig.mesh_object, loose_model)
    assert len(falling) == len(rig.mesh_object.data.vertices) and -0.2 < moved[:, 2].mean() < -0.001


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
    modifier.driver_add("show_viewport").driver.expression = "1"
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
    drive(modifiers["Hide"], "show_viewport", rig.armature_object, ("lower", "ROT_X"), "abs(value) > 0.1")
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
