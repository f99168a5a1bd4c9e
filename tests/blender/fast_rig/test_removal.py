# SPDX-License-Identifier: GPL-3.0-or-later
"""What a fast rig keeps: bones, objects and actions on which joints, controls and renders depend."""

import bpy
import numpy as np
import pytest

from blend_fixtures.characters.base import drive, link
from blend_fixtures.characters.bones import NewBone, add_bones, wave
from blend_fixtures.characters.dependencies import CONTROLS, DEPENDENCIES, SOURCE, UNUSED, studio_arm
from fdda_addon.core.errors import RigError
from fdda_addon.core.progress import run_job
from fdda_addon.fast_rig.compared_poses import ComparedPoses, differing_bones, evaluate_poses
from fdda_addon.fast_rig.controls import control_bones
from fdda_addon.fast_rig.graph_reader import read_graph, shown_objects
from fdda_addon.fast_rig.object_values import differing_objects, driven_properties
from fdda_addon.fast_rig.removal import remove_bones, remove_drivers, remove_unneeded
from fdda_addon.rig.references import Node
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.compatibility import animation_curves
from fdda_addon.scene.node_groups import BONE_NODE
from fdda_addon.scene.scene_rig import SceneRig

from ..conftest import ELBOW

REPLACED = {ELBOW: {"Armature", "Mush", "Lattice"}}

POSE_COUNT = 12

SIZE = 0.5
"""Length of the arm, meters."""

BENDY, HANDLE = "bendy", "handle"


@pytest.fixture
def scene_rig() -> SceneRig:
    """An arm with a control bone, a bone that nothing needs, and modifiers that a model replaces."""
    return SceneRig(*studio_arm())


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


def test_the_drivers_of_the_world_keep_their_bones(scene_rig):
    """A fast rig may be rendered from its own file, too."""
    world = bpy.context.scene.world = bpy.data.worlds.new("world")
    drive(world, "color", scene_rig.armature_object, f'pose.bones["{UNUSED}"].location[0]', index=0)
    removed = remove_unneeded([scene_rig], ["lower"], ["control"])
    assert removed.bones == {f"{UNUSED}_child"} and len(world.animation_data.drivers) == 1


@pytest.mark.parametrize("expression", ['self.id_data["bend"]', 'self["bend"]'])
def test_an_expression_with_self_keeps_the_drivers_of_what_it_reads(expression, scene_rig):
    """`self` is a bone or the armature object, whose custom property another bone drives."""
    armature_object = scene_rig.armature_object
    armature_object["bend"] = 0.0
    drive(armature_object, '["bend"]', armature_object, f'pose.bones["{UNUSED}"].location[0]')
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
    drive(pose_bone, "bbone_easein", armature_object, f'pose.bones["{UNUSED}"].location[0]')
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


def add_mesh_object(name: str, is_rendered: bool = True) -> bpy.types.Object:
    """Add an object with a mesh of one vertex."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([(0.0, 0.0, 0.0)], [], [])
    scene_object = link(bpy.data.objects.new(name, mesh))
    scene_object.hide_render = not is_rendered
    return scene_object


def remove(scene_rig: SceneRig) -> tuple[str, ...]:
    """Remove what `lower` and `control` do not need, and return the names of the removed objects."""
    return remove_unneeded([scene_rig], ["lower"], ["control"]).objects


@pytest.mark.parametrize("is_driven", [False, True])
def test_objects_that_renders_show_in_some_frames_stay(is_driven, scene_rig):
    prop = add_mesh_object("prop", is_rendered=False)
    add_mesh_object("never shown", is_rendered=False)
    if is_driven:
        prop.driver_add("hide_render").driver.expression = "1"
    else:
        prop.keyframe_insert("hide_render", frame=1)
    assert remove(scene_rig) == ("cage", "never shown")


@pytest.mark.parametrize("surface", ["none", "bevel", "extrusion", "fill", "NODES", "SCREW"])
def test_a_curve_that_deforms_the_mesh_stays_if_renders_show_it(surface, scene_rig):
    data = bpy.data.curves.new("path", "CURVE")
    data.dimensions, data.fill_mode = ("2D", "BOTH") if surface == "fill" else ("3D", "FULL")
    spline = data.splines.new("POLY")
    spline.points.add(2)
    spline.use_cyclic_u = surface == "fill"
    data.bevel_depth, data.extrude = 0.01 * (surface == "bevel"), 0.01 * (surface == "extrusion")
    curve = link(bpy.data.objects.new("path", data))
    if surface.isupper():
        curve.modifiers.new("Surface", surface)
    scene_rig.mesh_object.modifiers.new("Curve", "CURVE").object = curve
    assert remove(scene_rig) == (("cage", "path") if surface == "none" else ("cage",))


@pytest.mark.parametrize("modifier", ["CLOTH", "SOFT_BODY", "PARTICLE_SYSTEM"])
def test_what_simulations_collide_with_stays(modifier, scene_rig):
    simulated, collider = add_mesh_object("simulated"), add_mesh_object("collider", is_rendered=False)
    simulated.modifiers.new("Simulation", modifier)
    collider.modifiers.new("Collision", "COLLISION")
    wind = link(bpy.data.objects.new("wind", None))
    wind.hide_render = True
    bpy.context.view_layer.objects.active = wind
    bpy.ops.object.forcefield_toggle()
    assert remove(scene_rig) == ("cage",)
    # Without the simulation, nothing needs them.
    simulated.modifiers.clear()
    assert set(remove(scene_rig)) == {"collider", "wind"}


def test_rigid_bodies_and_their_constraints_stay_with_a_shown_one(scene_rig):
    bpy.ops.rigidbody.world_add()
    bodies = {name: add_mesh_object(name, is_rendered=name == "falling") for name in ("falling", "floor", "weight")}
    for body in bodies.values():
        bpy.context.view_layer.objects.active = body
        bpy.ops.rigidbody.object_add(type="PASSIVE" if body.name == "floor" else "ACTIVE")
    rope = link(bpy.data.objects.new("rope", None))
    rope.hide_render = True
    bpy.context.view_layer.objects.active = rope
    bpy.ops.rigidbody.constraint_add()
    rope.rigid_body_constraint.object1, rope.rigid_body_constraint.object2 = bodies["falling"], bodies["weight"]
    assert remove(scene_rig) == ("cage",)
    # Without a shown rigid body, nothing needs them.
    bodies["falling"].hide_render = True
    assert set(remove(scene_rig)) == {"falling", "floor", "weight", "rope"}


def test_actions_that_only_removed_objects_use_are_saved(tmp_path, scene_rig):
    cage = bpy.data.objects["cage"]
    cage.keyframe_insert("location", frame=1)
    cage.animation_data.action.name = "of the cage"
    assert cage.animation_data.action.users == 1
    remove(scene_rig)
    save_copy(tmp_path / "fast.blend")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "fast.blend"))
    assert "cage" not in bpy.data.objects and "of the cage" in bpy.data.actions


class NamedBone(bpy.types.PropertyGroup):
    """What an add-on may store with an object."""

    rig: bpy.props.PointerProperty(type=bpy.types.Object)
    bone: bpy.props.StringProperty()


@pytest.mark.parametrize(
    ("kind", "object_property", "bone_property"),
    [
        ("DISPLACE", "texture_coords_object", "texture_coords_bone"),
        ("WAVE", "texture_coords_object", "texture_coords_bone"),
        ("WARP", "object_to", "bone_to"),
        ("UV_WARP", "object_from", "bone_from"),
        ("VERTEX_WEIGHT_EDIT", "mask_tex_map_object", "mask_tex_map_bone"),
        ("HOOK", "object", "subtarget"),
        ("camera", "focus_object", "focus_subtarget"),
        ("constraint", "space_object", "space_subtarget"),
        ("strokes", "parent", "parent_bone"),
        ("property of an add-on", "rig", "bone"),
    ],
)
def test_bones_that_properties_of_shown_objects_name_stay(kind, object_property, bone_property, scene_rig):
    prop = add_mesh_object("prop")
    if kind == "camera":
        struct = bpy.data.cameras.new("camera").dof
        link(bpy.data.objects.new("camera", struct.id_data))
    elif kind == "constraint":
        struct = prop.constraints.new("LIMIT_LOCATION")
    elif kind == "strokes":
        bpy.ops.object.grease_pencil_add(type="STROKE")
        struct = bpy.context.object.data.layers[0]
    elif kind == "property of an add-on":
        bpy.utils.register_class(NamedBone)
        bpy.types.Object.named_bone = bpy.props.PointerProperty(type=NamedBone)
        struct = prop.named_bone
    else:
        struct = prop.modifiers.new("Modifier", kind)
    setattr(struct, object_property, scene_rig.armature_object)
    setattr(struct, bone_property, UNUSED)
    try:
        assert remove_unneeded([scene_rig], ["lower"], ["control"]).bones == {f"{UNUSED}_child"}
        assert getattr(struct, bone_property) == UNUSED
    finally:
        if kind == "property of an add-on":
            del bpy.types.Object.named_bone
            bpy.utils.unregister_class(NamedBone)


@pytest.mark.parametrize("reader", ["object", "material"])
def test_custom_properties_that_shaders_may_read_keep_their_drivers(reader, scene_rig):
    prop = add_mesh_object("prop")
    material = bpy.data.materials.new("material")
    prop.data.materials.append(material)
    owner = prop if reader == "object" else material
    owner["wetness"] = 0.0
    drive(owner, '["wetness"]', scene_rig.armature_object, f'pose.bones["{UNUSED}"].location[0]')
    assert remove_unneeded([scene_rig], ["lower"], ["control"]).bones == {f"{UNUSED}_child"}
    assert len(owner.animation_data.drivers) == 1


def test_objects_that_another_view_layer_renders_stay(scene_rig):
    collection = bpy.data.collections.new("second pass")
    bpy.context.scene.collection.children.link(collection)
    prop = add_mesh_object("prop")
    bpy.context.scene.collection.objects.unlink(prop)
    collection.objects.link(prop)
    bpy.context.scene.view_layers.new("second")
    bpy.context.view_layer.layer_collection.children["second pass"].exclude = True
    assert remove(scene_rig) == ("cage",)


@pytest.mark.parametrize("name", ["prop", "another"])
def test_objects_that_an_action_shows_stay_if_it_may_be_theirs(name, scene_rig):
    """The action is not assigned now."""
    prop = add_mesh_object("prop", is_rendered=False)
    another = add_mesh_object("another", is_rendered=False)
    another.keyframe_insert("location", frame=1)
    owner = bpy.data.objects[name]
    owner.keyframe_insert("hide_render", frame=1)
    owner.animation_data.action.use_fake_user = True
    prop.animation_data_clear()
    another.animation_data_clear()
    assert set(remove(scene_rig)) == {"cage", "prop", "another"} - {name}


def test_a_constraint_that_an_action_unmutes_counts(scene_rig):
    """The action is not assigned now."""
    armature_object = scene_rig.armature_object
    armature_object.animation_data_create().action = wave(armature_object, "control")
    constraint = armature_object.pose.bones["control"].constraints.new("COPY_ROTATION")
    constraint.target, constraint.subtarget, constraint.mute = armature_object, UNUSED, True
    constraint.keyframe_insert("mute", frame=1)
    armature_object.animation_data.action = None
    assert remove_unneeded([scene_rig], ["lower"], ["control"]).bones == {f"{UNUSED}_child"}


def test_paths_with_numbers_lead_to_the_same_elements_afterwards(scene_rig):
    """Removing bones and constraints changes the numbers of others."""
    armature_object = scene_rig.armature_object
    bones = armature_object.pose.bones
    action = wave(armature_object, UNUSED)
    constraints = bones[UNUSED].constraints
    constraints.new("COPY_ROTATION").mute = True
    constraints[0].target, constraints[0].subtarget = armature_object, f"{UNUSED}_child"
    constraints.new("LIMIT_SCALE").influence = 0.3
    # Of the three bones without weights, only the first is no control.
    number = bones.find(UNUSED)
    prop = add_mesh_object("prop")
    drive(prop, "location", armature_object, f"pose.bones[{number}].constraints[1].influence", index=0)
    drive(bones[UNUSED], "scale", armature_object, 'pose.bones["control"].location[0]', index=0)
    for curve in (*animation_curves(action), *armature_object.animation_data.drivers):
        curve.data_path = curve.data_path.replace(f'["{UNUSED}"]', f"[{number}]")
    add_mesh_object("another")
    removed = remove_unneeded([scene_rig], ["lower"], ["upper"])
    assert removed.bones == {f"{UNUSED}_child"} and len(armature_object.animation_data.drivers) == 1
    path = f'pose.bones["{UNUSED}"]'
    assert {curve.data_path for curve in animation_curves(action)} == {f"{path}.rotation_euler"}
    target = prop.animation_data.drivers[0].driver.variables[0].targets[0]
    assert target.data_path == f'{path}.constraints["Limit Scale"].influence'
    bpy.context.view_layer.update()
    assert prop.location.x == pytest.approx(0.3)


def test_modifiers_whose_settings_drivers_read_stay_and_are_read(scene_rig):
    mesh_object, prop = scene_rig.mesh_object, add_mesh_object("prop")
    mesh_object.modifiers["Mush"].factor = 0.7
    drive(prop, "location", mesh_object, 'modifiers["Mush"].factor', index=0)
    assert remove_unneeded([scene_rig], ["lower"], ["control"]).modifiers == ("Lattice",)
    bpy.context.view_layer.update()
    assert prop.location.x == pytest.approx(0.7)


def test_a_driver_that_reads_if_a_replaced_modifier_is_on_is_refused(scene_rig):
    """A model turns it off, so the object would be somewhere else."""
    prop = add_mesh_object("prop")
    drive(prop, "location", scene_rig.mesh_object, 'modifiers["Mush"].show_viewport', index=0)
    with pytest.raises(RigError, match="A driver reads if the modifier 'Mush' of 'elbow' is on, but a model turns it"):
        remove(scene_rig)


def add_readers_of_unused(armature_object: bpy.types.Object) -> set[str]:
    """Add what renders show differently in another pose of `unused`, and return what the comparison calls it."""
    scene, path = bpy.context.scene, f'pose.bones["{UNUSED}"].rotation_euler[0]'
    props = {
        name: add_mesh_object(name)
        for name in ("follower", "hidden", "pass", "skinned", "seen", "wet", "wet data", "painted", "shaded", "still")
    }
    for name in ("follower", "hidden", "pass"):
        props[name].parent, props[name].parent_type, props[name].parent_bone = armature_object, "BONE", UNUSED
    props["hidden"].hide_viewport = True
    collection = bpy.data.collections.new("second pass")
    scene.collection.children.link(collection)
    scene.collection.objects.unlink(props["pass"])
    collection.objects.link(props["pass"])
    scene.view_layers.new("second")
    bpy.context.view_layer.layer_collection.children["second pass"].exclude = True

    armature_object.data.bones[UNUSED].use_deform = True
    props["skinned"].vertex_groups.new(name=UNUSED).add([0], 1.0, "REPLACE")
    props["skinned"].modifiers.new("Armature", "ARMATURE").object = armature_object
    drive(props["seen"], "hide_render", armature_object, path, "value > 0.1")
    for owner in (props["wet"], props["wet data"].data):
        owner["wetness"] = 0.0
        drive(owner, '["wetness"]', armature_object, path)
    for name in ("painted", "shaded"):
        props[name].data.materials.append(bpy.data.materials.new(name))
    drive(props["painted"].data.materials[0], "roughness", armature_object, path)
    shaded = props["shaded"].data.materials[0]
    if shaded.node_tree is None:
        # Before Blender 5.0, materials have no nodes at first.
        shaded.use_nodes = True
    drive(shaded.node_tree.nodes["Principled BSDF"].inputs["Roughness"], "default_value", armature_object, path)

    curve = bpy.data.curves.new("tube", "CURVE")
    curve.splines.new("POLY").points.add(1)
    curve.splines[0].points[1].co = (0.1, 0.0, 0.0, 1.0)
    curve.bevel_depth = 0.01
    link(bpy.data.objects.new("tube", curve))
    drive(curve, "extrude", armature_object, path)
    light, scene.world = bpy.data.lights.new("lamp", "POINT"), bpy.data.worlds.new("sky")
    link(bpy.data.objects.new("lamp", light))
    drive(light, "energy", armature_object, path)
    drive(scene.world, "color", armature_object, path, index=0)
    instance, source = link(bpy.data.objects.new("instance", None)), bpy.data.objects.new("source", curve)
    source.parent, source.parent_type, source.parent_bone = armature_object, "BONE", UNUSED
    instance.instance_type, instance.instance_collection = "COLLECTION", bpy.data.collections.new("instances")
    instance.instance_collection.objects.link(source)
    objects = ("follower", "hidden", "pass", "skinned", "seen", "wet", "tube", "instance")
    data = ("mesh 'wet data'", "material 'painted'", "material 'shaded'", "curve 'tube'", "light 'lamp'")
    return {*(f"object '{name}'" for name in objects), *data, "world 'sky'"}


def test_the_comparison_finds_all_that_renders_show_differently(scene_rig):
    """An action that is not assigned moves the bone."""
    armature_object = scene_rig.armature_object
    action = wave(armature_object, UNUSED)
    expected = add_readers_of_unused(armature_object)
    bpy.context.view_layer.update()
    shown = tuple(shown_objects([scene_rig]))
    driven = tuple(driven_properties(shown))
    poses = ComparedPoses(armature_object, ("lower",), ("control",), (action,), 0.5, shown, driven, pose_count=2)
    before = run_job(evaluate_poses(poses, "poses"))
    again = run_job(evaluate_poses(poses, "poses"))
    assert differing_objects(before.objects, again.objects, 0.0) == {}
    for curve in animation_curves(action):
        curve.mute = True
    # Blender leaves what it set where a driver is removed.
    bpy.data.lights["lamp"].animation_data.drivers.remove(bpy.data.lights["lamp"].animation_data.drivers[0])
    after = run_job(evaluate_poses(poses, "poses"))
    assert differing_objects(before.objects, after.objects, 1e-5).keys() == expected
