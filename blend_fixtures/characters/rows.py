# SPDX-License-Identifier: GPL-3.0-or-later
"""The characters that are recorded, trained, bound and compared, a row each, by tests and for docs/characters.md."""

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
FEW_MOVES = 4
"""How often each joint is moved alone to find what it influences: enough for joints that influence much or nothing."""


@dataclass(frozen=True)
class Row:
    """A character, and what is recorded of it.

    Attributes:
        name: tells rows apart.
        topic: what it is an example of.
        text: the character in a rigger's words.
        build: builds it in the current scene.
        recording: how it is recorded.
        meshes: names of the mesh objects that get a model each.
        epochs: of the training.
        is_linear: the rig does plain linear skinning and nothing else, so there is nothing to learn, only to keep.
        is_linked: bound, then linked into another file and overridden twice, each in a pose of its own.
    """

    name: str
    topic: str
    text: str
    build: Callable[[], object]
    recording: RecordingSettings = field(default_factory=lambda: _recording())
    meshes: tuple[str, ...] = ("elbow",)
    epochs: int = 60
    is_linear: bool = False
    is_linked: bool = False


def _recording(**settings: object) -> RecordingSettings:
    return RecordingSettings(**{"poses": POSES, "influence_poses": FEW_MOVES, **settings})


def _limb(build: Callable[[], object], text: str, **settings: object) -> Row:
    return Row(build.__name__, SKINNING, text, build, meshes=("limb",), **settings)


def _tube(topic: str, build: Callable[[], object], text: str, **settings: object) -> Row:
    return Row(build.__name__, topic, text, build, **settings)


def _frames(build: Callable[[], object], text: str) -> Row:
    """A target that shows the frames of an action, and is compared on them."""
    settings = _recording(poses=0, actions=(ACTION,), target=TargetSettings(targets.TARGET))
    return _tube(TARGETS, build, f"{text}; learned from an action and compared on it", recording=settings)


def _settled(build: Callable[[], object], text: str) -> Row:
    """A simulation that is learned and compared in poses that settle."""
    target = TargetSettings(targets.TARGET, max_settle_frames=80, repeatability_poses=0)
    return _tube(TARGETS, build, f"{text}; poses settle", recording=_recording(poses=60, target=target))


ROWS: tuple[Row, ...] = (
    _limb(skinning.smooth_weights, "smooth weights alone", is_linear=True),
    _limb(skinning.many_influences, "seven bones a vertex, delta mush"),
    _tube(SKINNING, skinning.unnormalized, "weights that do not sum to 1, delta mush"),
    _tube(SKINNING, skinning.partly_missing, "vertices without weights, delta mush"),
    _limb(skinning.preserve_volume, "Preserve Volume"),
    _limb(skinning.envelopes, "bone envelopes, no vertex groups", is_linear=True),
    _limb(skinning.envelopes_where_groups_are_missing, "bone envelopes where there are no groups, delta mush"),
    _limb(skinning.b_bones, "B-Bones"),
    _limb(skinning.masked, "a vertex group in the Armature modifier, delta mush"),
    _limb(skinning.multi_modifier, "two Armature modifiers, Multi Modifier with Preserve Volume"),
    _tube(SKINNING, skinning.two_armatures, "two Armature modifiers, two armatures"),
    _limb(skinning.non_deforming_bones, "bones that do not deform among those that do, delta mush"),
    _limb(skinning.scaled_bones, "bones that scale, delta mush", recording=_recording(poses=120)),
    _tube(
        SKINNING,
        skinning.stretched,
        "a bone with Stretch To, delta mush",
        recording=_recording(sample=("bone:upper", "bone:target")),
    ),
    _tube(MODIFIERS, stacks.corrective_smooth, "Corrective Smooth, bound"),
    _tube(MODIFIERS, stacks.lattice, "Lattice, its shape key driven"),
    _tube(MODIFIERS, stacks.mesh_deform, "Mesh Deform, the cage's shape key driven"),
    _tube(MODIFIERS, stacks.surface_deform, "Surface Deform onto a skinned body"),
    _tube(MODIFIERS, stacks.shrinkwrap, "Shrinkwrap onto a skinned body"),
    _tube(MODIFIERS, stacks.smooth, "Smooth"),
    _tube(MODIFIERS, stacks.laplacian_smooth, "Laplacian Smooth"),
    _tube(MODIFIERS, stacks.laplacian_deform, "Laplacian Deform"),
    _tube(MODIFIERS, stacks.hook, "Hook to an empty on a bone"),
    _tube(MODIFIERS, stacks.cast, "Cast"),
    _tube(MODIFIERS, stacks.curve, "Curve, its shape key driven"),
    _tube(MODIFIERS, stacks.geometry_nodes, "Geometry Nodes that move vertices", recording=_recording(poses=120)),
    _tube(MODIFIERS, stacks.shape_keys, "a driven shape key, Preserve Volume"),
    _tube(MODIFIERS, stacks.absolute_shape_keys, "absolute shape keys, their time driven"),
    _tube(MODIFIERS, stacks.displace, "Displace"),
    _tube(MODIFIERS, stacks.simple_deform, "Simple Deform"),
    _tube(MODIFIERS, stacks.warp, "Warp between two empties"),
    _tube(MODIFIERS, stacks.subdivided, "delta mush; subdivision and thickness stay on"),
    _tube(
        CONTROL_RIGS,
        control_rigs.ik_fk,
        "an arm with IK and FK, posed by its control bones and by a custom property that blends",
        recording=_recording(poses=120, sample=("collection:Controls",), controls=('armature_object/["ik"]',)),
    ),
    _tube(
        CONTROL_RIGS,
        control_rigs.face_slider,
        "a slider bone that drives a shape key, a bone that follows a control bone",
        recording=_recording(sample=("collection:Controls",)),
    ),
    _tube(INPUTS, controls.custom_property, "a custom property that drives a shape key"),
    _tube(INPUTS, controls.free_shape_keys, "shape keys set by hand", recording=_recording(controls=("shape_keys",))),
    _tube(INPUTS, controls.constraint_influence, "a constraint's influence, which drives a shape key too"),
    _tube(INPUTS, controls.modifier_strength, "a custom property that drives a modifier's strength"),
    _tube(
        INPUTS,
        controls.undriven_strength,
        "a modifier's strength set by hand",
        recording=_recording(controls=('mesh_object/modifiers["Cast"].factor=0:0.4',)),
    ),
    _tube(
        INPUTS,
        controls.lattice_shape_key,
        "a lattice's shape key set by hand",
        recording=_recording(controls=('object:lattice/data.shape_keys.key_blocks["thick"].value',)),
    ),
    _tube(
        INPUTS,
        controls.dial,
        "another object's place, which drives a shape key",
        recording=_recording(controls=("object:dial/location[0]=0:0.5",)),
    ),
    Row(
        "face",
        INPUTS,
        "a face of 22 bones and 22 shape keys set by hand, with 12 correctives",
        face.face,
        _recording(poses=200, spread=10, controls=("shape_keys",)),
        meshes=(face.MESH,),
    ),
    Row(
        "body_and_sleeve",
        MESHES,
        "two meshes on one armature, a model each",
        meshes.body_and_sleeve,
        meshes=("elbow", "sleeve"),
    ),
    _tube(MESHES, transforms.moved, "mesh and armature moved, turned and scaled each by itself"),
    _tube(MESHES, transforms.parented_to_armature, "mesh parented to a turned and scaled armature"),
    _tube(MESHES, transforms.parented_to_empty, "armature parented to a moving empty"),
    _tube(MESHES, transforms.parented_to_bone, "mesh parented to a bone and skinned besides"),
    _tube(MESHES, transforms.in_centimetres, "a scene in centimeters"),
    _tube(MESHES, transforms.in_millimetres, "a scene in millimeters"),
    _tube(MESHES, transforms.in_kilometres, "a scene in kilometers"),
    _tube(MESHES, transforms.far_from_its_origin, "vertices 100 m from the origin of their object"),
    _tube(MESHES, transforms.scaled_armature, "an armature in centimeters, scaled by 0.01"),
    _tube(MESHES, transforms.scaled_character, "mesh and armature in centimeters, scaled by 0.01"),
    _tube(MESHES, transforms.far_away, "hundreds of meters from the origin"),
    Row(
        "linked", MESHES, "a linked character, overridden twice in two poses", stacks.corrective_smooth, is_linked=True
    ),
    _tube(
        MESHES,
        meshes.through_a_lattice,
        "no weights, only a lattice that follows the bones; fitted linear skinning",
        recording=_recording(fit_linear="smooth"),
    ),
    Row(
        "five_hundred_bones",
        MESHES,
        "500 bones, delta mush",
        meshes.five_hundred_bones,
        _recording(poses=60, influence_poses=1),
        meshes=("creature",),
        epochs=30,
    ),
    _tube(
        TARGETS,
        targets.target_copy,
        "a copy with delta mush is the target",
        recording=_recording(target=TargetSettings(targets.TARGET)),
    ),
    _frames(targets.target_alembic, "an Alembic file is the target"),
    _frames(targets.target_usd, "a USD file is the target"),
    _frames(targets.target_pc2, "a .pc2 file is the target"),
    _frames(targets.target_mdd, "an .mdd file is the target"),
    _frames(targets.target_shape_keys, "keyed shape keys are the target"),
    _settled(targets.target_soft_body, "a soft body is the target"),
    _settled(targets.target_cloth, "cloth is the target"),
    _settled(targets.target_geometry_nodes, "a simulation of Geometry Nodes is the target"),
)
