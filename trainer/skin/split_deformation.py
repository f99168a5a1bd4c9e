# SPDX-License-Identifier: GPL-3.0-or-later
"""Splits the recorded deformation into linear skinning and residuals: all steps up to partitions and influences."""

from dataclasses import replace

import numpy as np

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.formats.messages import FIT_STAGE, KEY_JOINTS_STAGE, MessageType
from fdda_addon.core.joint_option import ALL
from fdda_addon.core.mathematics.blocks import block_slices
from fdda_addon.core.mathematics.key_joints import find_unread_bones, joints_with_indices, select_joints
from fdda_addon.core.mathematics.metrics import distances
from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.mathematics.references import choose_references
from fdda_addon.core.mathematics.skin_fit import DEFAULT_KIND, FitReport, SkinFit
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.recording.skinned import SkinnedRecording, skin_recording
from fdda_addon.core.rig import Rig
from fdda_addon.core.wording import format_with_noun

from ..config import TrainingConfig
from ..progress import MessageSink
from .choice import choose_key_joints
from .fit_poses import FitPoses, read_fit_poses
from .key_joints import KeyJoints
from .solver import fit_skin

REFERENCE_POSES = 48
"""Number of poses by which the reference joints of a rig with fitted weights are chosen."""


def split_deformation(recording: Recording, config: TrainingConfig, sink: MessageSink) -> SkinnedRecording:
    """Split the deformation of a recording, with the settings `base_skinning`, `bones_to_read` and those of partitions.

    Args:
        recording: the recording.
        config: settings of the training.
        sink: receives the progress and the results of the fit.
    """
    rig, joint_count = recording.rig, len(recording.rig.joints)
    joints, choice, fit = np.arange(joint_count), None, None
    has_key_joints, unweighted = config.bones_to_read != ALL, rig.unweighted_vertices
    if has_key_joints or config.base_skinning or len(unweighted):
        vertices = None if has_key_joints or config.base_skinning else unweighted
        poses = read_fit_poses(recording, has_key_joints, vertices)
        if has_key_joints:
            choice = choose_key_joints(
                poses,
                config.bones_to_read,
                lambda done, total: sink.send(MessageType.PREPARING, stage=KEY_JOINTS_STAGE, done=done, total=total),
            )
        removes_joints = choice is not None and len(choice.joints) < joint_count
        if choice and not removes_joints:
            sink.send(MessageType.LOG, text=choice.report.sentence())
        fits_all = removes_joints or bool(config.base_skinning)
        if fits_all or len(unweighted):
            if not fits_all:
                meshes = zip(rig.meshes, rig.mesh_slices, strict=True)
                names = [mesh.name for mesh, part in meshes if part.start in unweighted]
                subject = format_with_noun(names, "mesh", "meshes")
                verb = "has" if len(names) == 1 else "have"
                sink.send(MessageType.LOG, text=f"Skin weights are fitted for {subject}, which {verb} none.")
                poses = poses.of_vertices(unweighted) if vertices is None else poses
            kind, weighted = config.base_skinning or DEFAULT_KIND, choice.weighted_joints if removes_joints else joints
            training, held_out = poses.subset(slice(0, None, 2)), poses.subset(slice(1, None, 2))
            fitted_joints, weights = fit_skin(
                training.with_joints(weighted) if removes_joints else training,
                kind,
                lambda done: sink.send(MessageType.PREPARING, stage=FIT_STAGE, done=done, total=poses.rig.vertex_count),
            )
            fitted = weighted[fitted_joints].astype(np.int32), weights
            fitted_rig = replace(poses.rig, skin_joints=fitted[0], skin_weights=fitted[1])
            reports = measure_skin(held_out, fitted_rig), measure_skin(training, fitted_rig)
            if not fits_all:
                fitted = [np.pad(each, ((0, 0), (0, rig.skin_joints.shape[1] - each.shape[1]))) for each in fitted]
                own = rig.skin_joints.copy(), rig.skin_weights.copy()
                for array, rows in zip(own, fitted, strict=True):
                    array[unweighted] = rows
                fitted = own
            rig = replace(rig, skin_joints=fitted[0], skin_weights=fitted[1])
            fit = SkinFit(kind, len(poses.positions), *reports, choice.report if removes_joints else None)
            sink.send(MessageType.LOG, text=fit.sentence())
            if removes_joints:
                joints, rig = choice.joints, keep_key_joints(recording, rig, choice)
            rig = _choose_references(recording, rig, joints, poses)
    if fit is None:
        check_has_weights(recording)

    def follow(partition: Partition, influences: np.ndarray) -> np.ndarray:
        if len(joints) == joint_count:
            return influences
        influences[:joint_count] |= choice.acts[partition.vertices].any(axis=0)
        return influences @ choice.inputs

    skinned = skin_recording(
        recording,
        rig,
        joints,
        follow,
        config.min_vertices_per_part,
        config.influence_tolerance,
        lambda text: sink.send(MessageType.LOG, text=text),
    )
    return replace(skinned, fit=fit, key_joints=choice.report if choice else None)


def keep_key_joints(recording: Recording, fitted_rig: Rig, choice: KeyJoints) -> Rig:
    """Return a rig with its key joints alone; its fingerprint describes the bones that follow these."""
    own_rig = recording.rig
    key_rig = select_joints(own_rig, joints_with_indices(own_rig, choice.joints.tolist()))
    bones = recording.info.bones
    unread = {
        name: bones.settings[name]
        for name in find_unread_bones(bones.sources, bones.controlled, own_rig, key_rig.joint_names)
        if name in bones.settings
    }
    indices = np.zeros(len(own_rig.joints), np.int32)
    indices[choice.joints] = np.arange(len(choice.joints))
    return replace(
        key_rig,
        skin_joints=indices[fitted_rig.skin_joints],
        skin_weights=fitted_rig.skin_weights,
        meshes=tuple(
            replace(
                mesh,
                fingerprint=replace(
                    mesh.fingerprint, deformation=mesh.fingerprint.deformation | {"unread_bones": unread}
                ),
            )
            for mesh in key_rig.meshes
        ),
    )


def _choose_references(recording: Recording, rig: Rig, joints: np.ndarray, poses: FitPoses) -> Rig:
    """Choose the reference joints of a rig with fitted weights; `joints` are the indices of its joints."""
    rig = replace(rig, joints=tuple(replace(joint, reference=None) for joint in rig.joints))
    compared = np.linspace(0, len(poses.positions) - 1, REFERENCE_POSES).round().astype(int)
    is_fixed = np.isin(joints, recording.info.bones.fixed)
    return choose_references(rig, is_fixed, poses.pose_matrices[np.unique(compared)][:, joints])


def check_has_weights(recording: Recording) -> None:
    """Check that vertices of the rig have weights on deforming bones.

    Raises:
        TrainingError: no vertex follows a bone.
    """
    if not recording.rig.has_weights:
        raise TrainingError(
            f"The vertices of '{recording.rig.meshes[0].name}' follow no bone by skin weights, so there is no linear "
            "skinning to learn from; have one fitted (--base-skinning smooth, or Base Skinning in the sidebar), or "
            "paint weights and record again."
        )


def measure_skin(poses: FitPoses, fitted: Rig) -> FitReport:
    """Measure the errors of linear skinning with the rig's own and with the fitted weights."""
    rms, maxima = {}, {}
    for name, rig in (("rig", poses.rig), ("fitted", fitted)):
        skinning, squares, maximum = LinearSkinning(rig), 0.0, 0.0
        for block in block_slices(len(poses.positions), 3 * fitted.vertex_count):
            positions = skinning.positions(poses.pose_matrices[block])
            errors = distances(positions, poses.positions[block], fitted.metres_per_unit).astype(np.float64)
            squares, maximum = squares + float((errors**2).sum()), max(maximum, float(errors.max()))
        rms[name] = 1000 * (squares / (len(poses.positions) * fitted.vertex_count)) ** 0.5
        maxima[name] = 1000 * maximum
    return FitReport(rms, maxima)
