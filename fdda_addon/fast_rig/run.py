# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes a fast rig of the open file: binds the models, removes what nothing needs, compares, and saves a copy."""

from dataclasses import dataclass, replace
from pathlib import Path

from ..core.errors import RigError
from ..core.formats.model import read_model
from ..core.progress import Job
from ..core.rig import STATIC_JOINT
from ..core.wording import format_count
from ..rig.modifier_stack import check_evaluable
from ..rig.references import Node, driven_node, split_bone_path
from ..runtime import packed_model
from ..runtime.binding import bind, check_plays, unbind
from ..runtime.model_files import network_of
from ..scene.blend_file import save_copy
from ..scene.controls import owner_of
from ..scene.scene_rig import SceneRig
from .compared_poses import (
    ComparedPoses,
    Evaluation,
    differing_bones,
    evaluate_poses,
    infinite_bones,
    playable_actions,
    rig_size,
)
from .controls import control_bones, keyed_bones
from .graph_reader import shown_objects
from .object_values import differing_objects, driven_properties
from .removal import Removed, remove_unneeded

TOLERANCE = 1e-5
"""Largest accepted difference of a joint between full rig and fast rig, as a ratio of the size of the rig."""
REPEATED_POSES = 10
"""Number of random poses that are evaluated again, to find out whether the full rig repeats its result."""
MAX_NAMED = 5


@dataclass(frozen=True)
class FastRig:
    """The result of `make_fast_rig`.

    Attributes:
        armature_name: name of the armature object.
        size: size of the full rig, armature units.
        bones_before, bones_after: number of bones of the full rig and of the fast rig.
        joints: number of joints that the models read.
        controls: names of the chosen control bones.
        removed: what was removed.
        lost_channels: number of keyed channels that have lost their bones, by action and bone.
        object_count: number of objects that were compared.
        pose_count: number of poses in which bones and objects were compared.
        largest_difference: largest difference in these, as a ratio of the size of the rig.
        moving_joints: number of joints that move in these.
        infinite_bones: number of these poses in which both rigs give a bone no finite transform, by its name.
        unrepeated: names of objects that look different in the same pose, so that they were not compared.
    """

    armature_name: str
    size: float
    bones_before: int
    bones_after: int
    joints: int
    controls: tuple[str, ...]
    removed: Removed
    lost_channels: dict[str, dict[str, int]]
    object_count: int
    pose_count: int
    largest_difference: float
    moving_joints: int
    infinite_bones: dict[str, int]
    unrepeated: tuple[str, ...]


def make_fast_rig(rigs_and_models: list[tuple[SceneRig, Path]], out: Path, choices: tuple[str, ...]) -> Job[FastRig]:
    """Make a fast rig of the open file and save it while the generator is iterated.

    The open file is changed and not saved itself, so run this in a process of its own.

    Args:
        rigs_and_models: the rigs, which share one armature, each with the path of its model.
        out: path of the file to write.
        choices: the control bones to keep, as for `control_bones`.

    Raises:
        FDDAError: a rig or model is refused, a bone that is read or posed or an object that is rendered looks different
            without what is removed, or the file cannot be written. Nothing is written.
    """
    scene_rigs = [scene_rig for scene_rig, _ in rigs_and_models]
    armature_object, *others = dict.fromkeys(rig.armature_object for rig in scene_rigs)
    if others:
        names = " and ".join(f"'{each.name}'" for each in (armature_object, *others))
        raise RigError(f"The models play on several armatures, {names}; make a fast rig of one armature at a time.")
    for mesh_object in (rig.mesh_object for rig in scene_rigs):
        if mesh_object.fdda.is_fast_rig:
            raise RigError(f"'{mesh_object.name}' is a fast rig already; give the file of the full rig.")
    joint_names = bind_packed_models(rigs_and_models)
    controls = tuple(sorted(control_bones(armature_object, choices)))
    if not controls:
        raise RigError(
            f"'{armature_object.name}' has no bones for --controls {' '.join(choices)}, so the fast rig would have "
            "nothing to animate; choose other controls: visible, keyed or collection:NAME, a bone collection."
        )
    bone_names = tuple(dict.fromkeys((*joint_names, *controls)))
    actions, shown = playable_actions(armature_object), tuple(shown_objects(scene_rigs))
    driven, size = tuple(driven_properties(shown)), rig_size(armature_object)
    poses = ComparedPoses(armature_object, bone_names, controls, actions, size, shown, driven)
    before, unrepeated = yield from _evaluate_full_rig(poses)
    bones_before = len(armature_object.data.bones)
    keyed = {action.name: counts for action, counts in keyed_bones(armature_object, actions).items()}
    removed = remove_unneeded_parts(scene_rigs, joint_names, controls)
    after = yield from evaluate_poses(poses, "fast rig")

    if differences := differing_bones(poses, before.matrices, after.matrices, TOLERANCE):
        raise RigError(
            f"Without the removed bones, {_named_bones(differences)} of '{armature_object.name}', which the model "
            "reads or animators pose, would move differently; keep more bones with --controls collection:NAME."
        )
    differences = differing_objects(before.objects, after.objects, -1.0)
    compared = {name: difference for name, difference in differences.items() if name not in unrepeated}
    texts = [
        f"another {name} (relative difference {difference:.1e})"
        for name, difference in _largest_first(compared)
        if difference > TOLERANCE
    ]
    if texts:
        raise RigError(
            f"Without the removed bones and objects, renders would show {_listed(texts)}; keep more bones with "
            "--controls collection:NAME."
        )
    save_copy(out)
    lost_channels = {
        action: {bone: n for bone, n in counts.items() if bone in removed.bones} for action, counts in keyed.items()
    }
    return FastRig(
        armature_object.name,
        poses.size,
        bones_before,
        len(armature_object.data.bones),
        len(joint_names),
        controls,
        removed,
        {action: counts for action, counts in lost_channels.items() if counts},
        len(shown),
        len(before.matrices),
        max((*differing_bones(poses, before.matrices, after.matrices, -1.0).values(), *compared.values()), default=0.0),
        len(set(differing_bones(poses, before.matrices, before.matrices[:1], TOLERANCE)) & set(joint_names)),
        infinite_bones(poses, before.matrices),
        tuple(unrepeated),
    )


def bind_packed_models(rigs_and_models: list[tuple[SceneRig, Path]]) -> tuple[str, ...]:
    """Bind the models of rigs and pack them; return the names of the joints that they read."""
    joint_names: list[str] = []
    for scene_rig, model in rigs_and_models:
        mesh_object = scene_rig.mesh_object
        unbind(mesh_object)
        check_evaluable(scene_rig)
        data = read_model(model)[1]
        text = packed_model.pack(model.name, data)
        bind(scene_rig, model, use_in_render=True, packed_text=text)
        binding = mesh_object.fdda
        # The other models of the library were trained for the full rig, and their files may not be there.
        binding.models.clear()
        entry = binding.models.add()
        entry.name, entry.path, entry.packed, entry.packed_bytes = model.stem, binding.model, text, len(data)
        binding.model_index = 0
        check_plays(mesh_object)
        joint_names += network_of(mesh_object).info.joint_names
    return tuple(dict.fromkeys(name for name in joint_names if name != STATIC_JOINT))


def remove_unneeded_parts(
    scene_rigs: list[SceneRig], joint_names: tuple[str, ...], controls: tuple[str, ...]
) -> Removed:
    """Remove what models and controls do not need, and play the models."""
    for scene_rig in scene_rigs:
        scene_rig.mesh_object.fdda.mode = "RIG"
    removed = remove_unneeded(scene_rigs, joint_names, controls, _model_nodes(scene_rigs))
    for scene_rig in scene_rigs:
        scene_rig.mesh_object.fdda.is_fast_rig = True
        scene_rig.mesh_object.fdda.mode = "FDDA"
        check_plays(scene_rig.mesh_object)
    return removed


def _model_nodes(scene_rigs: list[SceneRig]) -> list[Node]:
    """Return the extra inputs that the models read."""
    nodes = []
    for scene_rig in scene_rigs:
        for control in network_of(scene_rig.mesh_object).info.controls:
            owner = owner_of(scene_rig, control.owner)
            if owner is None:
                continue  # A control of a mesh that is not here.
            nodes += [Node(owner), driven_node(owner, control.path)]
            if bone_name := split_bone_path(owner, control.path)[0]:
                nodes.append(Node(scene_rig.armature_object, bone_name))
    return nodes


def _evaluate_full_rig(poses: ComparedPoses) -> Job[tuple[Evaluation, list[str]]]:
    """Evaluate the full rig; return also the names of the objects that do not repeat.

    Simulated objects may depend on the poses before.
    """
    full = yield from evaluate_poses(poses, "full rig")
    # Of an action, only objects, which may be simulated: its first frame may depend on the pose before.
    again = yield from evaluate_poses(
        replace(poses, actions=poses.actions[:1], pose_count=REPEATED_POSES), "repeated poses"
    )
    indices = [
        *range(REPEATED_POSES),
        *range(poses.pose_count, poses.pose_count + len(again.matrices) - REPEATED_POSES),
    ]
    if differences := differing_bones(poses, *(e.matrices[:REPEATED_POSES] for e in (full, again)), TOLERANCE):
        raise RigError(
            f"Evaluating the same pose again moves {_named_bones(differences)} of '{poses.armature_object.name}' "
            "differently, so a fast rig cannot be compared; look for dependency cycles among constraints and drivers."
        )
    first = {name: [values[index] for index in indices] for name, values in full.objects.items()}
    return full, list(differing_objects(first, again.objects, TOLERANCE))


def _named_bones(differences: dict[str, float]) -> str:
    """Return the number of bones that differ, with the names and differences of the largest."""
    texts = [f"'{name}' by {difference:.1e} of the size" for name, difference in _largest_first(differences)]
    return f"{format_count(len(differences), 'bone')} ({_listed(texts)})"


def _largest_first(differences: dict[str, float]) -> list[tuple[str, float]]:
    return sorted(differences.items(), key=lambda item: item[1], reverse=True)


def _listed(texts: list[str]) -> str:
    """Return the first of some texts, and the number of others."""
    more = f" and {len(texts) - MAX_NAMED} more" if len(texts) > MAX_NAMED else ""
    return ", ".join(texts[:MAX_NAMED]) + more
