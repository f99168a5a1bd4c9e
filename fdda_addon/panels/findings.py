# SPDX-License-Identifier: GPL-3.0-or-later
"""What makes a good model unlikely, found before a recording, each with the operator that mends it."""

from typing import NamedTuple

from ..core.checks.seams import count_split_vertices
from ..core.rig import Rig
from ..poses.motion_range import unlimited_bones
from ..properties.recording_options import bones_to_pose
from ..recording.rig_check import RigCheck
from ..scene.draw_cache import computed_once
from ..scene.scene_rig import SceneRig
from . import checks, limits


class Finding(NamedTuple):
    """A finding: a sentence, and the operator that mends it; empty if there is none."""

    text: str
    operator: str = ""


def find(rig: SceneRig) -> tuple[Finding, ...]:
    """Return the findings about a mesh at its last check, for drawing."""
    check, mesh_object = checks.last_check(rig), rig.mesh_object
    if check is None or check.rig is None or mesh_object.fdda.is_bound:
        return ()
    settings = mesh_object.fdda.settings
    inputs = (
        check,
        *((m.show_viewport, getattr(m, "use_deform_preserve_volume", False)) for m in mesh_object.modifiers),
        settings.base_skinning,
        settings.bones_to_read,
        settings.bones_to_pose,
        settings.has_random_poses,
        bool(settings.learn_from),
    )
    return computed_once(("findings", mesh_object.session_uid), inputs, lambda: tuple(_find(rig, check)))


def _find(rig: SceneRig, check: RigCheck) -> list[Finding]:
    mesh_object, bones, findings = rig.mesh_object, rig.armature_object.pose.bones, []
    settings, joint_names = mesh_object.fdda.settings, [name for name in check.rig.joint_names if name in bones]
    if settings.base_skinning == "RIG" and settings.bones_to_read == "ALL" and not check.rig.has_weights:
        text = f"No vertex of {mesh_object.name} has weights on deforming bones."
        findings.append(Finding(text, "fdda.fit_base_skinning"))
    modifiers = [m for m in mesh_object.modifiers if m.name in check.replaced_modifiers and m.show_viewport]
    has_keys = mesh_object.data.shape_keys is not None and len(mesh_object.data.shape_keys.key_blocks) > 1
    is_linear = (
        [(m.type, getattr(m, "use_deform_preserve_volume", False)) for m in modifiers] == [("ARMATURE", False)]
        and not has_keys
        and not settings.learn_from
        and all(bones[name].bone.bbone_segments == 1 for name in joint_names)
    )
    if is_linear:
        findings.append(Finding(f"Only linear skinning deforms {mesh_object.name}: a model is not worth it."))
    elif count := _count_split_vertices(rig, check.rig):
        text = f"{count:,} of {check.rig.vertex_count:,} vertices lie on others along cuts, which come apart."
        findings.append(Finding(text, "fdda.merge_vertices"))
    names = unlimited_bones(rig.armature_object, check.rig)
    if controlled_count := limits.count_controlled_bones(rig):
        text = f"{controlled_count:,} of {len(joint_names):,} deforming bones follow control bones. "
        findings.append(Finding(f"{text}Check actions that move these, or choose them as Bones to Pose."))
    elif names and bones_to_pose(rig) == "WEIGHTS" and settings.has_random_poses and limits.has_any_limits(rig):
        text = f"{len(names):,} of {len(joint_names):,} bones have no rotation limits, and turn by ±45°."
        findings.append(Finding(text, "fdda.select_unlimited"))
    return findings


def _count_split_vertices(rig: SceneRig, arrays: Rig) -> int:
    """Count the split vertices of a mesh, again only if it was read again; most checks read no mesh."""
    positions = arrays.rest_positions
    name = "split vertices", rig.mesh_object.session_uid
    # The array is stored with the count, so that no other array gets its id.
    return computed_once(name, (id(positions),), lambda: (positions, count_split_vertices(arrays)))[1]
