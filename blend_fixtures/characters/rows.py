# SPDX-License-Identifier: GPL-3.0-or-later
"""List the characters that tests and docs/characters.md record, train, bind and compare, one row per character."""

from collections.abc import Callable
from dataclasses import dataclass, field

from blend_fixtures.elbow import ACTION
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.rig.pose_setter import TargetSettings

from . import control_rigs, controls, face, meshes, skinning, stacks, targets, transforms

SKINNING, MODIFIERS, CONTROL_RIGS, INPUTS, MESHES, TARGETS = (
    "Skinning",
    "Modifiers",
    "Control rigs",
    "Inputs beside joints",
    "Meshes and objects",
    "Targets",
)
POSES = 80
INFLUENCE_POSES = 4
"""Poses that move a joint alone to find its influences. A few are enough: a joint moves vertices far or not at all."""


@dataclass(frozen=True)
class Row:
    """A character with its settings.

    Attributes:
        name: unique name of the row.
        topic: heading of the row's table.
        text: description of the character for riggers.
        build: function that builds the character in the current scene.
        recording: settings of the recording.
        meshes: names of the mesh objects; each gets a model.
        epochs: epochs of the training.
        training: further options of the training.
        is_linear: whether the rig is only linear skinning, so that the model must be exact.
        is_linked: whether the bound character is linked into another file and overridden twice, in different poses.
    """

    name: str
    topic: str
    text: str
    build: Callable[[], object]
    recording: RecordingSettings = field(default_factory=lambda: _recording_settings())
    meshes: tuple[str, ...] = ("elbow",)
    epochs: int = 60
    training: tuple[str, ...] = ()
    is_linear: bool = False
    is_linked: bool = False


def _recording_settings(**settings: object) -> RecordingSettings:
    return RecordingSettings(**{"poses": POSES, "influence_poses": INFLUENCE_POSES, **settings})


def _limb_row(build: Callable[[], object], text: str, **settings: object) -> Row:
    return Row(build.__name__, SKINNING, text, build, meshes=("limb",), **settings)


def _tube_row(topic: str, build: Callable[[], object], text: str, **settings: object) -> Row:
    return Row(build.__name__, topic, text, build, **settings)


def _action_row(build: Callable[[], object], text: str) -> Row:
    """Return a row whose target plays an action; the model is trained and compared on the frames of the action."""
    settings = _recording_settings(poses=0, actions=(ACTION,), target=TargetSettings(targets.TARGET))
    return _tube_row(TARGETS, build, f"{text}; trained and compared on an action", recording=settings)


def _settled_row(build: Callable[[], object], text: str) -> Row:
    """Return a row whose target is simulated; the model is trained and compared on settled poses."""
    target = TargetSettings(targets.TARGET, settle_frames=80)
    return _tube_row(
        TARGETS,
        build,
        f"{text}; trained and compared on settled poses",
        recording=_recording_settings(poses=60, target=target),
    )


ROWS: tuple[Row, ...] = (
    _limb_row(skinning.smooth_weights, "smooth weights alone", is_linear=True),
    _limb_row(skinning.many_influences, "seven bones per vertex, delta mush"),
    _tube_row(SKINNING, skinning.unnormalized, "weights that do not sum to 1, delta mush"),
    _tube_row(SKINNING, skinning.partly_missing, "vertices without weights, delta mush"),
    _limb_row(skinning.preserve_volume, "Preserve Volume"),
    _limb_row(skinning.envelopes, "bone envelopes, no vertex groups", is_linear=True),
    _limb_row(skinning.envelopes_where_groups_are_missing, "bone envelopes for vertices without groups, delta mush"),
    _limb_row(skinning.b_bones, "B-Bones"),
    _limb_row(skinning.masked, "an Armature modifier with a vertex group, delta mush"),
    _limb_row(skinning.multi_modifier, "two Armature modifiers, Multi Modifier with Preserve Volume"),
    _tube_row(SKINNING, skinning.two_armatures, "two Armature modifiers, two armatures"),
    _limb_row(skinning.non_deforming_bones, "non-deforming bones among deforming bones, delta mush"),
    _limb_row(skinning.scaled_bones, "bones that scale, delta mush", recording=_recording_settings(poses=120)),
    _tube_row(
        SKINNING,
        skinning.stretched,
        "a bone with Stretch To, delta mush",
        recording=_recording_settings(bones_to_pose=("bone:upper", "bone:target")),
    ),
    _tube_row(MODIFIERS, stacks.corrective_smooth, "Corrective Smooth, bound"),
    _tube_row(MODIFIERS, stacks.lattice, "Lattice with a driven shape key"),
    _tube_row(MODIFIERS, stacks.mesh_deform, "Mesh Deform, whose cage has a driven shape key"),
    _tube_row(MODIFIERS, stacks.surface_deform, "Surface Deform onto a skinned body"),
    _tube_row(MODIFIERS, stacks.shrinkwrap, "Shrinkwrap onto a skinned body"),
    _tube_row(MODIFIERS, stacks.smooth, "Smooth"),
    _tube_row(MODIFIERS, stacks.laplacian_smooth, "Laplacian Smooth"),
    _tube_row(MODIFIERS, stacks.laplacian_deform, "Laplacian Deform"),
    _tube_row(MODIFIERS, stacks.hook, "Hook to an empty on a bone"),
    _tube_row(MODIFIERS, stacks.cast, "Cast"),
    _tube_row(MODIFIERS, stacks.curve, "Curve with a driven shape key"),
    _tube_row(
        MODIFIERS, stacks.geometry_nodes, "Geometry Nodes that move vertices", recording=_recording_settings(poses=120)
    ),
    _tube_row(MODIFIERS, stacks.shape_keys, "a driven shape key, Preserve Volume"),
    _tube_row(MODIFIERS, stacks.absolute_shape_keys, "absolute shape keys with a driven evaluation time"),
    _tube_row(MODIFIERS, stacks.displace, "Displace"),
    _tube_row(MODIFIERS, stacks.simple_deform, "Simple Deform"),
    _tube_row(MODIFIERS, stacks.warp, "Warp between two empties"),
    _tube_row(MODIFIERS, stacks.subdivided, "delta mush, then Subdivision Surface and Solidify, which stay on"),
    _tube_row(
        CONTROL_RIGS,
        control_rigs.ik_fk,
        "an arm with IK and FK, posed by its control bones and by a custom property that blends between the two",
        recording=_recording_settings(
            poses=120, bones_to_pose=("collection:Controls",), extra_inputs=('armature_object/["ik"]',)
        ),
    ),
    _tube_row(
        CONTROL_RIGS,
        control_rigs.face_slider,
        "a slider bone that drives a shape key, a bone that follows a control bone",
        recording=_recording_settings(bones_to_pose=("collection:Controls",)),
    ),
    _tube_row(INPUTS, controls.custom_property, "a custom property that drives a shape key"),
    _tube_row(INPUTS, controls.free_shape_keys, "shape keys set by hand"),
    _tube_row(INPUTS, controls.constraint_influence, "a constraint's influence, which also drives a shape key"),
    _tube_row(INPUTS, controls.modifier_strength, "a custom property that drives a modifier's strength"),
    _tube_row(
        INPUTS,
        controls.undriven_strength,
        "a modifier's strength set by hand",
        recording=_recording_settings(extra_inputs=('mesh_object/modifiers["Cast"].factor=0:0.4',)),
    ),
    _tube_row(
        INPUTS,
        controls.lattice_shape_key,
        "a lattice's shape key set by hand",
        recording=_recording_settings(extra_inputs=('object:lattice/data.shape_keys.key_blocks["thick"].value',)),
    ),
    _tube_row(
        INPUTS,
        controls.dial,
        "another object's location, which drives a shape key",
        recording=_recording_settings(extra_inputs=("object:dial/location[0]=0:0.5",)),
    ),
    Row(
        "face",
        INPUTS,
        "a face of 22 bones and 22 shape keys set by hand, with 12 correctives",
        face.face,
        _recording_settings(poses=200, spread=10),
        meshes=(face.MESH,),
    ),
    Row(
        "body_and_sleeve",
        MESHES,
        "two meshes on one armature, with one model per mesh",
        meshes.body_and_sleeve,
        meshes=("elbow", "sleeve"),
    ),
    _tube_row(MESHES, transforms.moved, "mesh and armature moved, rotated and scaled separately"),
    _tube_row(MESHES, transforms.parented_to_armature, "mesh parented to a rotated and scaled armature"),
    _tube_row(MESHES, transforms.parented_to_empty, "armature parented to a moving empty"),
    _tube_row(MESHES, transforms.parented_to_bone, "mesh parented to a bone and also skinned"),
    _tube_row(MESHES, transforms.in_centimetres, "a scene in centimeters"),
    _tube_row(MESHES, transforms.in_millimetres, "a scene in millimeters"),
    _tube_row(MESHES, transforms.in_kilometres, "a scene in kilometers"),
    _tube_row(MESHES, transforms.far_from_its_origin, "vertices 100 m from the object's origin"),
    _tube_row(MESHES, transforms.scaled_armature, "an armature in centimeters, scaled by 0.01"),
    _tube_row(MESHES, transforms.scaled_character, "mesh and armature in centimeters, scaled by 0.01"),
    _tube_row(MESHES, transforms.far_away, "hundreds of meters from the origin"),
    Row(
        "linked", MESHES, "a linked character, overridden twice in two poses", stacks.corrective_smooth, is_linked=True
    ),
    _tube_row(
        MESHES,
        meshes.through_a_lattice,
        "no weights: a lattice follows the bones and deforms the mesh; fitted linear skinning",
        training=("--base-skinning", "smooth"),
    ),
    Row(
        "five_hundred_bones",
        MESHES,
        "500 bones, delta mush",
        meshes.five_hundred_bones,
        _recording_settings(poses=60, influence_poses=1),
        meshes=("creature",),
        epochs=30,
    ),
    _tube_row(
        TARGETS,
        targets.target_copy,
        "a copy with delta mush is the target",
        recording=_recording_settings(target=TargetSettings(targets.TARGET)),
    ),
    _action_row(targets.target_alembic, "an Alembic file is the target"),
    _action_row(targets.target_usd, "a USD file is the target"),
    _action_row(targets.target_pc2, "a .pc2 file is the target"),
    _action_row(targets.target_mdd, "an .mdd file is the target"),
    _action_row(targets.target_shape_keys, "a mesh with keyed shape keys is the target"),
    _settled_row(targets.target_soft_body, "a soft body is the target"),
    _settled_row(targets.target_cloth, "cloth is the target"),
    _settled_row(targets.target_geometry_nodes, "a Geometry Nodes simulation is the target"),
)
