# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings that users make in the sidebar, and the paths that follow from them.

`Object.fdda.settings` of the mesh describes the character and `Action.fdda` an action; both are saved with the file.
`WindowManager.fdda` is what the sidebar shows at the moment and is not meant to last.
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

from ..core.defaults import EPOCHS, GOAL_MM, MARGIN, MIN_PARTITION_VERTICES, POSES, SPREAD, TOLERANCE_MM
from ..core.errors import OutputError
from ..scene.scene_rig import SceneRig, armature_of
from ..scene.stored_paths import resolve_path
from .without_keys import without_keys


@without_keys
class FDDA_PG_bone(bpy.types.PropertyGroup):
    """A bone that random poses move."""

    name: StringProperty(name="Bone")


def _suggested_controls(control: "FDDA_PG_control", _context: bpy.types.Context, _text: str) -> list[str]:
    from ..scene.control_names import suggested_controls

    mesh_object = control.id_data
    armature_object = armature_of(mesh_object)
    return suggested_controls(SceneRig(mesh_object, armature_object)) if armature_object else []


@without_keys
class FDDA_PG_control(bpy.types.PropertyGroup):
    """A number that is an input of the model, as `scene.controls.parse_controls` reads it."""

    name: StringProperty(
        name="Control",
        description="Name of a shape key, or OWNER/PATH of a number that can be animated",
        search=_suggested_controls,
        search_options={"SUGGESTION"},
    )
    has_range: BoolProperty(
        name="Own Range", description="Sample it in this range, in place of the one that its property has"
    )
    low: FloatProperty(name="Minimum", description="Lowest value of random poses", default=0.0)
    high: FloatProperty(name="Maximum", description="Highest value of random poses", default=1.0)


@without_keys
class FDDA_PG_character(bpy.types.PropertyGroup):
    """How a character is sampled, recorded and trained; saved with its mesh object."""

    poses: IntProperty(
        name="Poses", description="Number of random poses to record", default=POSES, min=0, soft_max=10000
    )
    seed: IntProperty(name="Seed", description="Other seeds give other random poses", min=0)
    spread: FloatProperty(
        name="Spread",
        description="Standard deviation of the random poses as a part of half the range of motion: "
        "small stays near the middle, large fills the range evenly. An elbow of 0 to 140°: at 0.5 most poses have it "
        "between 35 and 105°, at 10 all angles are as frequent",
        default=SPREAD,
        min=0.05,
        max=10.0,
        step=10,
    )
    margin: FloatProperty(
        name="Margin",
        description="A quarter of the random poses is drawn from so many times the range of motion, and turns locked "
        "axes too, so that the model knows what is beyond; Limit constraints are off meanwhile. 1 for none",
        default=MARGIN,
        min=1.0,
        max=4.0,
        step=10,
    )
    sample: EnumProperty(
        name="Random Poses Move",
        description="Bones that random poses move",
        items=(
            ("WEIGHTS", "Bones with Weights", "The bones that the mesh follows, and all that state a range of motion"),
            ("COLLECTION", "Bone Collection", "The bones of a bone collection and of the ones below it"),
            ("ACTIONS", "Ticked Actions", "What the actions that are ticked for recording key, in their ranges"),
            ("SELECTED", "Selected Bones", "The bones that were selected when Use Selected Bones was pressed"),
        ),
        default="WEIGHTS",
    )
    bone_collection: StringProperty(name="Collection", description="Bone collection with what animators pose")
    sampled_bones: CollectionProperty(type=FDDA_PG_bone)
    controls: CollectionProperty(type=FDDA_PG_control)
    control_index: IntProperty(name="Control", description="The control that the fields below are about")
    fit_linear: EnumProperty(
        name="Linear Layer",
        description="Skin weights of linear skinning that a model learns to correct",
        items=(
            ("RIG", "Rig's Weights", "The weights that the mesh has, as they are"),
            ("HARD", "Fitted, Rigid", "One joint a vertex, the one that explains the recorded poses best"),
            ("SMOOTH", "Fitted, Smooth", "At most four joints a vertex, with the weights that explain the poses best"),
        ),
        default="RIG",
    )
    target: StringProperty(
        name="Target",
        description="Mesh object whose surface is recorded in place of what the rig shows: a copy under other "
        "modifiers, a cache, a simulation, with the same vertices; empty for the rig itself",
    )
    pre_roll: IntProperty(
        name="Pre-Roll",
        description="Frames before the first of an action, in which a simulated target goes from the rest pose to it",
        min=0,
        soft_max=100,
    )
    max_settle_frames: IntProperty(
        name="Settle",
        description="Frames for which a random pose is held at most until a simulated target is at rest; 0 to record "
        "none of them",
        min=0,
        soft_max=200,
    )
    mirror: BoolProperty(
        name="Mirrored",
        description="Record each frame of the actions a second time, left and right exchanged; the armature has to be "
        "the same on both sides",
    )
    recording: StringProperty(
        name="Folder",
        description="Folder of the recording; empty for one beside the .blend file",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    min_partition_vertices: IntProperty(
        name="Least Vertices",
        description="Parts of the mesh with fewer vertices go with another part, which has the network; 0 for none. A "
        "tongue bone with 5 vertices, for example, goes with the jaw",
        default=MIN_PARTITION_VERTICES,
        min=0,
        soft_max=100,
    )
    model: StringProperty(
        name="Model",
        description="File that the trained model is written to; empty for one in a folder beside the .blend file",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    tolerance_mm: FloatProperty(
        name="Tolerance (mm)",
        description="Error that a part of the mesh may keep at least; smaller is more exact and slower. 0.05 cannot be "
        "seen in a close-up of a face, 0.5 not in a full figure",
        default=TOLERANCE_MM,
        min=0.001,
        soft_max=1.0,
        precision=3,
        step=1,
    )
    goal_mm: FloatProperty(
        name="Target (mm)",
        description="What 99.9 % of the held-out vertices are to be within; 0 for no goal",
        default=GOAL_MM,
        min=0.0,
        soft_max=10.0,
        precision=2,
        step=10,
    )
    epochs: IntProperty(
        name="Epochs",
        description="Passes over the recorded poses; more is more exact and takes longer",
        default=EPOCHS,
        min=1,
        soft_max=1000,
    )
    training_seed: IntProperty(name="Seed", description="Other seeds start the training elsewhere", min=0)


def wanted_fit(settings: FDDA_PG_character) -> str:
    """Kind of the skin weights that are fitted (`core.skin_fit.KINDS`); empty for those of the rig."""
    return "" if settings.fit_linear == "RIG" else settings.fit_linear.lower()


@without_keys
class FDDA_PG_action(bpy.types.PropertyGroup):
    """What an action is used for; saved with it."""

    record: BoolProperty(name="Record", description="Record the frames of this action after the random poses")


@without_keys
class FDDA_PG_session(bpy.types.PropertyGroup):
    """What the sidebar shows at the moment."""

    mesh: StringProperty(name="Mesh", description="The mesh of the active armature that the sidebar shows")
    all_meshes: BoolProperty(
        name="All Meshes",
        description="The buttons work on all meshes that follow this armature, and not on the one that is shown alone",
        default=True,
    )

    pose_number: IntProperty(
        name="Random Pose", description="Number of the random pose that is shown, as it is recorded", min=0
    )
    joint_index: IntProperty(name="Joint")
    action_index: IntProperty(name="Action")
    show_all_partitions: BoolProperty(name="Show All", description="All partitions of the model, not only the worst")


CLASSES = (FDDA_PG_bone, FDDA_PG_control, FDDA_PG_character, FDDA_PG_action, FDDA_PG_session)


def register() -> None:
    """Give actions and the window manager their properties; `Object.fdda` is made in `binding`."""
    bpy.types.Action.fdda = PointerProperty(type=FDDA_PG_action)
    bpy.types.WindowManager.fdda = PointerProperty(type=FDDA_PG_session)


def unregister() -> None:
    """Undo `register`."""
    del bpy.types.WindowManager.fdda
    del bpy.types.Action.fdda


def recording_folder(mesh_object: bpy.types.Object) -> Path:
    """Where the character is recorded: the folder that it names, else FILE_NAME_recording beside the .blend file.

    Raises:
        OutputError: it is to lie beside a file that has not been saved.
    """
    name = _file_name(mesh_object)
    return _path(mesh_object.fdda.settings.recording, f"{name}_recording", "folder for the recording")


def model_file(mesh_object: bpy.types.Object) -> Path:
    """Where the character's model is written: the file that it names, else FILE_NAME_model/FILE_NAME.onnx.

    That is beside the .blend file. A folder of its own: the trainer writes its report beside the model.

    Raises:
        OutputError: it is to lie beside a file that has not been saved.
    """
    name = _file_name(mesh_object)
    return _path(mesh_object.fdda.settings.model, f"{name}_model/{name}.onnx", "file for the model")


def trained_file(mesh_object: bpy.types.Object) -> Path | None:
    """The model that a training of the character has written, None when there is none."""
    try:
        path = model_file(mesh_object)
    except OutputError:
        return None
    return path if path.is_file() else None


def _file_name(mesh_object: bpy.types.Object) -> str:
    """Names of the .blend file and of the mesh in one: files of a folder may have meshes of the same name."""
    file, name = Path(bpy.data.filepath).stem, mesh_object.name
    return bpy.path.clean_name(name if name == file else f"{file}_{name}")


def _path(stated: str, beside: str, what: str) -> Path:
    if not bpy.data.filepath and (not stated or stated.startswith("//")):
        raise OutputError(
            f"The .blend file has not been saved, so there is no place beside it; save it, or name a {what}."
        )
    return resolve_path(stated or f"//{beside}")
