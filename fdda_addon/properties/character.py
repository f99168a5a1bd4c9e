# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of characters and actions, saved in the .blend file, and the paths that follow from them.

The settings of a character are `Object.fdda.settings` of its mesh object; those of an action are `Action.fdda`.
"""

from pathlib import Path

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..core import settings
from ..core.errors import OutputError
from ..scene.controls import control_at, suggested_controls
from ..scene.scene_rig import SceneRig, armature_of
from ..scene.stored_paths import resolve_path


def not_animatable(property_group: type[bpy.types.PropertyGroup]) -> type[bpy.types.PropertyGroup]:
    """Remove the option ANIMATABLE from the properties of a group that set no options themselves."""
    nested_types = (bpy.props.CollectionProperty, bpy.props.PointerProperty)
    for property_definition in property_group.__annotations__.values():
        if property_definition.function not in nested_types:
            property_definition.keywords.setdefault("options", set())
    return property_group


MAX_INT = (1 << 31) - 1
"""Largest value of an integer property."""


def make_property(setting: settings.Setting, **arguments: object) -> object:
    """Make Blender's property of a setting, with further arguments."""
    kinds = {bool: BoolProperty, int: IntProperty, float: FloatProperty, str: StringProperty}
    limits = {"min": setting.low} if setting.kind in (int, float) else {}
    if setting.high < MAX_INT:
        limits["max"] = setting.high
    values = {"default": setting.default, **limits, **setting.ui, **arguments}
    return kinds[setting.kind](name=setting.label, description=setting.description, **values)


def _leave_automatic_poses(character: "FDDA_PG_character", _context: bpy.types.Context) -> None:
    character.auto_poses = False


@not_animatable
class FDDA_PG_bone(bpy.types.PropertyGroup):
    """A bone that random poses move."""

    name: StringProperty(name="Bone")


def _suggested_controls(control: "FDDA_PG_control", _context: bpy.types.Context, _text: str) -> list[str]:
    mesh_object = control.id_data
    armature_object = armature_of(mesh_object)
    return suggested_controls(SceneRig(mesh_object, armature_object)) if armature_object else []


def _shorten_data_path(control: "FDDA_PG_control", _context: bpy.types.Context) -> None:
    """Replace a pasted full data path with the name of its control."""
    armature_object = armature_of(control.id_data)
    if armature_object is None:
        return
    name = control_at(SceneRig(control.id_data, armature_object), control.name)
    if name != control.name:
        control.name = name


@not_animatable
class FDDA_PG_control(bpy.types.PropertyGroup):
    """Extra inputs of the model, in the syntax of `split_control_bones` and `parse_controls`."""

    name: StringProperty(
        name="Extra Input",
        description="Name of a shape key, or data path of any animated number. Paste the result of Copy Full Data Path",
        search=_suggested_controls,
        update=_shorten_data_path,
        search_options={"SUGGESTION"},
    )
    has_range: BoolProperty(
        name="Override Range", description="Use this range instead of the minimum and maximum of the property"
    )
    low: FloatProperty(name="Minimum", description="Lowest value in random poses", default=0.0)
    high: FloatProperty(name="Maximum", description="Highest value in random poses", default=1.0)


@not_animatable
class FDDA_PG_character(bpy.types.PropertyGroup):
    """Settings of the poses, the recording and the training of a character."""

    poses: make_property(settings.POSES, update=_leave_automatic_poses)
    auto_poses: make_property(settings.AUTO_POSES)
    seed: make_property(settings.SEED)
    spread: make_property(settings.SPREAD)
    overshoot: make_property(settings.OVERSHOOT)
    bones_to_pose: EnumProperty(
        name="Bones to Pose",
        description="Bones that random poses move",
        items=(
            (
                "AUTO",
                "Automatic",
                "Limbs from the checked actions. Without any, the deforming bones and all bones with limits; if there "
                "are no limits, limbs from all actions of the rig",
            ),
            ("WEIGHTS", "Deforming Bones", "The bones that deform the mesh, and all bones with limits"),
            ("COLLECTION", "Bone Collection", "The bones of a bone collection and of its child collections"),
            (
                "ACTIONS",
                "Bones in the Checked Actions",
                "The bones that the checked actions key, in the ranges they use",
            ),
            (
                "REMIX",
                "Limbs from the Checked Actions",
                "The bones that the checked actions key; every second pose combines limbs from different frames",
            ),
            ("SELECTED", "Selected Bones", "The bones that were selected when Use Selected Bones was pressed"),
        ),
        default="AUTO",
    )
    bone_collection: StringProperty(name="Collection", description="Bone collection with the bones that animators pose")
    sampled_bones: CollectionProperty(type=FDDA_PG_bone)
    extra_inputs: CollectionProperty(type=FDDA_PG_control)
    extra_input_index: IntProperty(name="Extra Input", description="Active input of the list")
    base_skinning: EnumProperty(
        name="Base Skinning",
        description="Skin weights of the linear skinning that the model corrects",
        items=(
            ("RIG", "From the Rig", "The weights of the mesh"),
            ("HARD", "Fit (1 bone per vertex)", "Find the bone for each vertex that fits the recorded poses best"),
            ("SMOOTH", "Fit (4 bones per vertex)", "Find up to four weights per vertex that fit the poses best"),
        ),
        default="RIG",
    )
    bones_to_read: EnumProperty(
        name="Bones to Read",
        description="The bones that the model reads; what the others do is learned, where it follows from these",
        items=(
            ("ALL", "All", "All bones that move the mesh"),
            ("AUTO", "Fewest", "The fewest bones from which the others follow in random poses"),
            ("NUMBER", "Number", "A number of bones. Others that move independently are lost"),
        ),
        default="ALL",
    )
    bone_count: IntProperty(
        name="Number of Bones", description="How many bones the model reads", default=50, min=1, soft_max=500
    )
    learn_from: make_property(settings.LEARN_FROM)
    pre_roll: make_property(settings.PRE_ROLL)
    settle_frames: make_property(settings.SETTLE_FRAMES)
    mirror: make_property(settings.MIRROR)
    recording: StringProperty(
        name="Folder",
        description="Folder of the recording. Empty for a folder next to the .blend file",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    min_vertices_per_part: make_property(settings.MIN_VERTICES_PER_PART)
    model: StringProperty(
        name="Model",
        description="File to write the trained model to. Empty for a file in a folder next to the .blend file",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    detail_mm: make_property(settings.DETAIL_MM)
    use_goal: BoolProperty(name="Goal (mm)", description="Report after the training whether the goal is met")
    goal_mm: make_property(settings.GOAL_MM)
    passes: make_property(settings.PASSES)
    training_seed: make_property(settings.TRAINING_SEED)

    @property
    def has_random_poses(self) -> bool:
        """Return whether random poses are recorded."""
        return self.auto_poses or self.poses > 0


@not_animatable
class FDDA_PG_action(bpy.types.PropertyGroup):
    """Settings of an action."""

    record: BoolProperty(name="Record", description="Record the frames of this action too")


CLASSES = (FDDA_PG_bone, FDDA_PG_control, FDDA_PG_character, FDDA_PG_action)
PROPERTIES = {(bpy.types.Action, "fdda"): PointerProperty(type=FDDA_PG_action)}


def default_recording(mesh_object: bpy.types.Object) -> str:
    """Return the default folder of the recording, relative to the .blend file."""
    return f"//{_file_name(mesh_object)}_recording"


def default_model(mesh_object: bpy.types.Object) -> str:
    """Return the default file of the model, relative to the .blend file.

    The model has a separate folder, because the trainer writes its report next to the model.
    """
    name = _file_name(mesh_object)
    return f"//{name}_model/{name}.onnx"


def recording_folder(mesh_object: bpy.types.Object) -> Path:
    """Return the folder of the recording: the chosen one, else FILE_NAME_recording next to the .blend file."""
    return _resolve_path(mesh_object.fdda.settings.recording, default_recording(mesh_object), "recording", "Folder")


def model_file(mesh_object: bpy.types.Object) -> Path:
    """Return the file of the model: the chosen one, else FILE_NAME_model/FILE_NAME.onnx next to the .blend file."""
    return _resolve_path(mesh_object.fdda.settings.model, default_model(mesh_object), "model", "Model file")


def file_problem(mesh_object: bpy.types.Object) -> str:
    """Return a sentence if recording and model cannot be stored before the .blend file is saved; empty if they can."""
    try:
        recording_folder(mesh_object)
        model_file(mesh_object)
    except OutputError as error:
        return str(error)
    return ""


def trained_file(mesh_object: bpy.types.Object) -> Path | None:
    """Return the model file that a training of the character has written; None if there is none."""
    try:
        path = model_file(mesh_object)
    except OutputError:
        return None
    return path if path.is_file() else None


def _file_name(mesh_object: bpy.types.Object) -> str:
    """Return a file name made of the names of the .blend file and the mesh, so that characters do not share files."""
    file, name = Path(bpy.data.filepath).stem, mesh_object.name
    return bpy.path.clean_name(name if file in ("", name) else f"{file}_{name}")


def _resolve_path(stored_path: str, default: str, kind: str, field: str) -> Path:
    if not bpy.data.filepath and (not stored_path or stored_path.startswith("//")):
        raise OutputError(f"Save the .blend file first ({kind}s are stored next to it), or choose a {field}.")
    return resolve_path(stored_path or default)
