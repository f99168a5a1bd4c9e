# SPDX-License-Identifier: GPL-3.0-or-later
"""Build an arm whose deforming bones depend on other bones in every way that Blender has.

Each function of `DEPENDENCIES` makes the bone `lower` of a tube depend on the bone `source`, which has no weights.
"""

import bpy

from .base import drive, link, tube
from .bones import NewBone, add_bone_collection, add_bones, add_delta_mush
from .controls import add_property

SOURCE, UNUSED, CONTROLS, MECHANISM = "source", "unused", "Controls", "Mechanism"
_SOURCE_HEAD = (0.25, 0.0, 0.3)


def studio_arm(*names: str) -> tuple[bpy.types.Object, bpy.types.Object]:
    """Build a tube with delta mush, a control, unused bones, an unused cage, and the named dependencies.

    The control bone `control` is in the bone collection `Controls`, which is visible. It moves the bones `source.NAME`,
    one for each dependency, which are in the hidden collection `Mechanism`. So are `unused` and its child.
    """
    mesh_object, armature_object = tube()
    armature_object.animation_data_clear()
    for action in list(bpy.data.actions):
        bpy.data.actions.remove(action)
    add_bones(
        armature_object,
        NewBone("control", (0.0, 0.0, 0.3), (0.1, 0.0, 0.3), is_deforming=False),
        NewBone(UNUSED, (0.0, 0.0, 0.4), (0.1, 0.0, 0.4), is_deforming=False),
        NewBone(f"{UNUSED}_child", (0.1, 0.0, 0.4), (0.2, 0.0, 0.4), UNUSED, is_deforming=False),
    )
    control = armature_object.pose.bones["control"]
    control.lock_location = control.lock_rotation = (False, False, False)
    for name in names:
        source = f"{SOURCE}.{name}"
        add_bones(
            armature_object,
            NewBone(source, _SOURCE_HEAD, (0.35, 0.0, 0.3), "control", is_deforming=False),
        )
        bone = armature_object.pose.bones[source]
        bone.lock_location = bone.lock_rotation = bone.lock_scale = (False, False, False)
        DEPENDENCIES[name](armature_object, source)
    deforming = [bone.name for bone in armature_object.data.bones if bone.use_deform]
    mechanism = [b.name for b in armature_object.data.bones if b.name not in {"control", *deforming}]
    add_bone_collection(armature_object, CONTROLS, "control")
    add_bone_collection(armature_object, MECHANISM, *deforming, *mechanism)
    armature_object.data.collections[MECHANISM].is_visible = False
    add_delta_mush(mesh_object)
    cage = link(bpy.data.objects.new("cage", bpy.data.lattices.new("cage")))
    cage.modifiers.new("Hook", "HOOK").object = armature_object
    cage.modifiers["Hook"].subtarget = "lower"
    mesh_object.modifiers.new("Lattice", "LATTICE").object = cage
    return mesh_object, armature_object


def _constrain(
    armature_object: bpy.types.Object, kind: str, source: str, bone: str = "lower", influence: float = 0.3
) -> bpy.types.Constraint:
    """Add a constraint whose target is a bone, and return it."""
    constraint = armature_object.pose.bones[bone].constraints.new(kind)
    constraint.name, constraint.influence = source, influence
    if hasattr(constraint, "subtarget"):
        constraint.target, constraint.subtarget = armature_object, source
    return constraint


def _target(armature_object: bpy.types.Object, source: str) -> None:
    _constrain(armature_object, "COPY_ROTATION", source)


def _custom_space(armature_object: bpy.types.Object, source: str) -> None:
    limit = _constrain(armature_object, "LIMIT_ROTATION", source)
    limit.use_limit_z, limit.owner_space = True, "CUSTOM"
    limit.space_object, limit.space_subtarget = armature_object, source


def _armature_constraint(armature_object: bpy.types.Object, source: str) -> None:
    constraint = _constrain(armature_object, "ARMATURE", source, influence=0.5)
    for name in ("upper", source):
        target = constraint.targets.new()
        target.target, target.subtarget, target.weight = armature_object, name, 0.5


def _ik(armature_object: bpy.types.Object, source: str) -> None:
    """Solve `lower` with the IK constraint of a bone below it."""
    tip = f"tip.{source}"
    add_bones(armature_object, NewBone(tip, (0.5, 0.0, 0.0), (0.6, 0.0, 0.0), "lower", is_deforming=False))
    for name in ("lower", "upper"):
        armature_object.pose.bones[name].lock_ik_y = False
    constraint = _constrain(armature_object, "IK", source, tip, influence=0.4)
    constraint.chain_count = 2


def _pole(armature_object: bpy.types.Object, source: str) -> None:
    _ik(armature_object, "control")
    constraint = armature_object.pose.bones["tip.control"].constraints[-1]
    constraint.pole_target, constraint.pole_subtarget = armature_object, source


def _spline_ik(armature_object: bpy.types.Object, source: str) -> None:
    """Bend `lower` along a curve whose end is hooked to the source."""
    data = bpy.data.curves.new("spline", "CURVE")
    data.dimensions = "3D"
    spline = data.splines.new("POLY")
    spline.points.add(2)
    for point, x in zip(spline.points, (0.25, 0.35, 0.5), strict=True):
        point.co = (x, 0.0, 0.0, 1.0)
    curve = link(bpy.data.objects.new("spline", data))
    hook = curve.modifiers.new("Hook", "HOOK")
    hook.object, hook.subtarget = armature_object, source
    hook.vertex_indices_set([2])
    constraint = _constrain(armature_object, "SPLINE_IK", source, influence=0.5)
    constraint.target, constraint.chain_count = curve, 1


def _action(armature_object: bpy.types.Object, source: str) -> None:
    """Play an action on `lower` according to the rotation of the source."""
    action = bpy.data.actions.new(f"pose.{source}")
    action.use_fake_user = True
    animation = armature_object.animation_data_create()
    animation.action = action
    bone = armature_object.pose.bones["lower"]
    for frame, angle in ((1, 0.0), (20, 0.5)):
        bone.rotation_euler[0] = angle
        bone.keyframe_insert("rotation_euler", index=0, frame=frame)
    bone.rotation_euler[0] = 0.0
    slot = getattr(animation, "action_slot", None)
    animation.action = None
    constraint = _constrain(armature_object, "ACTION", source, influence=1.0)
    constraint.action, constraint.transform_channel = action, "ROTATION_X"
    if slot is not None:
        constraint.action_slot = slot
    constraint.target_space, constraint.min, constraint.max = "LOCAL", -0.5, 0.5
    constraint.frame_start, constraint.frame_end = 1, 20


def _drive(armature_object: bpy.types.Object, kind: str, **settings: object) -> bpy.types.Driver:
    """Drive the rotation of `lower` with a variable, and return the driver."""
    driver = armature_object.pose.bones["lower"].driver_add("rotation_euler", 0).driver
    driver.type = "SUM"
    variable = driver.variables.new()
    variable.type = kind
    for target in variable.targets:
        for name, value in settings.items():
            setattr(target, name, value)
    return driver


def _property(armature_object: bpy.types.Object, source: str) -> None:
    path = f'pose.bones["{source}"].scale[0]'
    _drive(armature_object, "SINGLE_PROP", id=armature_object, data_path=path)


def _transform_channel(armature_object: bpy.types.Object, source: str) -> None:
    _drive(armature_object, "TRANSFORMS", id=armature_object, bone_target=source, transform_type="LOC_X")


def _rotation_difference(armature_object: bpy.types.Object, source: str) -> None:
    driver = _drive(armature_object, "ROTATION_DIFF", id=armature_object, bone_target=source)
    driver.variables[-1].targets[1].bone_target = "upper"


def _distance(armature_object: bpy.types.Object, source: str) -> None:
    driver = _drive(armature_object, "LOC_DIFF", id=armature_object, bone_target=source)
    driver.variables[-1].targets[1].bone_target = "upper"


def _context_property(armature_object: bpy.types.Object, source: str) -> None:
    path = f'objects["{armature_object.name}"].pose.bones["{source}"].scale[1]'
    _drive(armature_object, "CONTEXT_PROP", data_path=path)


def _view_layer_property(armature_object: bpy.types.Object, source: str) -> None:
    """Drive `lower` by a custom property of the view layer that the source drives."""
    view_layer = bpy.context.view_layer
    view_layer["bend"] = 0.0
    drive(bpy.context.scene, f'{view_layer.path_from_id()}["bend"]', armature_object, (source, "LOC_Z"))
    _drive(armature_object, "CONTEXT_PROP", context_property="ACTIVE_VIEW_LAYER", data_path='["bend"]')


def _pointer(armature_object: bpy.types.Object, source: str) -> None:
    """Drive `lower` by a bone that a path names through the parent of an object."""
    child = link(bpy.data.objects.new("child", None))
    child.parent = armature_object
    _drive(armature_object, "SINGLE_PROP", id=child, data_path=f'parent.pose.bones["{source}"].location[1]')


def _driven_property(armature_object: bpy.types.Object, source: str) -> None:
    """Drive `lower` by a custom property of the object that the source drives."""
    add_property(armature_object, "bend")
    drive(armature_object, '["bend"]', armature_object, (source, "LOC_Z"))
    _drive(armature_object, "SINGLE_PROP", id=armature_object, data_path='["bend"]')


def _driven_influence(armature_object: bpy.types.Object, source: str) -> None:
    """Drive the influence of a constraint of `lower`."""
    drive(_constrain(armature_object, "COPY_ROTATION", "control"), "influence", armature_object, (source, "LOC_X"))


def _bone_parent(armature_object: bpy.types.Object, source: str) -> None:
    """Copy the rotation of an object whose parent is the source."""
    empty = link(bpy.data.objects.new("empty", None))
    empty.parent, empty.parent_type, empty.parent_bone = armature_object, "BONE", source
    empty.hide_render = True
    constraint = _constrain(armature_object, "COPY_ROTATION", source)
    constraint.target = empty


def _surface(armature_object: bpy.types.Object, source: str) -> None:
    """Track a vertex group of a mesh that the source deforms."""
    mesh = bpy.data.meshes.new("surface")
    mesh.from_pydata([(0.25, 0.0, 0.3), (0.3, 0.0, 0.3), (0.25, 0.1, 0.3)], [], [(0, 1, 2)])
    surface = link(bpy.data.objects.new("surface", mesh))
    surface.hide_render = True
    armature_object.data.bones[source].use_deform = True
    surface.vertex_groups.new(name=source).add([0, 1, 2], 1.0, "REPLACE")
    surface.modifiers.new("Armature", "ARMATURE").object = armature_object
    constraint = _constrain(armature_object, "DAMPED_TRACK", source)
    constraint.target, constraint.subtarget = surface, source


def _b_bone_handle(armature_object: bpy.types.Object, source: str) -> None:
    """Track the middle of a B-Bone whose handle is the source."""
    name = f"bendy.{source}"
    add_bones(armature_object, NewBone(name, (0.25, 0.0, 0.2), (0.45, 0.0, 0.2), is_deforming=False))
    bone = armature_object.data.bones[name]
    bone.bbone_segments, bone.bbone_handle_type_end = 8, "ABSOLUTE"
    bone.bbone_custom_handle_end = armature_object.data.bones[source]
    constraint = _constrain(armature_object, "DAMPED_TRACK", name)
    constraint.head_tail, constraint.use_bbone_shape = 0.5, True


DEPENDENCIES = {
    function.__name__.removeprefix("_"): function
    for function in (
        *(_target, _custom_space, _armature_constraint, _ik, _pole, _spline_ik, _action, _property, _transform_channel),
        *(_rotation_difference, _distance, _context_property, _driven_property, _driven_influence, _bone_parent),
        *(_surface, _b_bone_handle, _view_layer_property, _pointer),
    )
}
"""Functions that make `lower` depend on a bone, by the name of the way: (armature object, name of the bone) -> None."""
