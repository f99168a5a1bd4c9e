# SPDX-License-Identifier: GPL-3.0-or-later
"""Splits the recorded deformation into linear skinning and residuals: all steps up to partitions and influences."""

from dataclasses import replace
from functools import partial

import numpy as np

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.formats.messages import FIT_STAGE, KEY_JOINTS_STAGE, MessageType
from fdda_addon.core.mathematics.blocks import block_slices
from fdda_addon.core.mathematics.key_joints import find_unread_bones, joints_with_indices, select_joints
from fdda_addon.core.mathematics.metrics import distances
from fdda_addon.core.mathematics.references import choose_references
from fdda_addon.core.mathematics.skin_fit import DEFAULT_KIND, FitReport, SkinFit
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.recording.skinned import SkinnedRecording, skin_recording
from fdda_addon.core.rig import Rig
from fdda_addon.core.settings import ALL
from fdda_addon.core.wording import format_with_noun

from ..config import TrainingConfig
from ..progress import MessageSink
from .fit_poses import FitPoses, read_fit_poses
from .key_joints import choose_key_joints
from .solver import fit_skin

REFERENCE_POSES = 48
"""Number of poses by which the reference joints of a rig with fitted weights are chosen."""


def split_deformation(recording: Recording, config: TrainingConfig, sink: MessageSink) -> SkinnedRecording:
    """Split the deformation of a recording, with the settings `base_skinning`, `bones_to_read` and those of partitions.

    Args:
        config: settings of the training.
        sink: receives the progress and the results of the fit.

    Raises:
        TrainingError: the rig has no skin weights, and none are fitted.
    """
    rig, chooses_joints, unweighted = recording.rig, config.bones_to_read != ALL, recording.rig.unweighted_vertices
    joints, choice, fit, follows = np.arange(len(rig.joints)), None, None, None

    def send_progress(stage: str, done: int, total: int) -> None:
        sink.send(MessageType.PREPARING, stage=stage, done=done, total=total)

    def log(text: str) -> None:
        sink.send(MessageType.LOG, text=text)

    fits_all = chooses_joints or bool(config.base_skinning)
    if fits_all or len(unweighted):
        poses = read_fit_poses(recording, chooses_joints, None if fits_all else unweighted)
        if chooses_joints:
            choice = choose_key_joints(poses, config.bones_to_read, partial(send_progress, KEY_JOINTS_STAGE))
            if len(choice.joints) == len(joints):
                log(choice.report.sentence())
                fits_all = bool(config.base_skinning)
                poses = poses if fits_all else poses.of_vertices(unweighted)
            else:
                follows, joints = (choice.acts, choice.inputs), choice.joints
        if poses.rig.vertex_count:
            if not fits_all:
                meshes = zip(rig.meshes, rig.mesh_slices, strict=True)
                names = [mesh.name for mesh, part in meshes if part.start in unweighted]
                subject = format_with_noun(names, "mesh", "meshes")
                log(f"Skin weights are fitted for {subject}, which {'has' if len(names) == 1 else 'have'} none.")
            weighted = choice.weighted_joints if follows else joints
            kind = config.base_skinning or DEFAULT_KIND
            training, held_out = poses.subset(slice(0, None, 2)), poses.subset(slice(1, None, 2))
            fitted_joints, weights = fit_skin(
                training.with_joints(weighted) if follows else training,
                kind,
                lambda done: send_progress(FIT_STAGE, done, poses.rig.vertex_count),
            )
            fitted_joints = weighted[fitted_joints].astype(np.int32)
            fitted_rig = replace(poses.rig, skin_joints=fitted_joints, skin_weights=weights)
            errors = measure_skin(held_out, fitted_rig), measure_skin(training, fitted_rig)
            fit = SkinFit(kind, len(poses.positions), *errors, choice.report if follows else None)
            log(fit.sentence())
            if not fits_all:
                padding, fitted = ((0, 0), (0, rig.skin_joints.shape[1] - weights.shape[1])), (fitted_joints, weights)
                fitted_joints, weights = rig.skin_joints.copy(), rig.skin_weights.copy()
                fitted_joints[unweighted], weights[unweighted] = (np.pad(each, padding) for each in fitted)
            rig = replace(rig, skin_joints=fitted_joints, skin_weights=weights)
            if follows:
                rig = keep_key_joints(recording, rig, joints)
            # Choose the reference joints of a rig with fitted weights.
            rig = replace(rig, joints=tuple(replace(joint, reference=None) for joint in rig.joints))
            compared = np.unique(np.linspace(0, len(poses.positions) - 1, REFERENCE_POSES).round().astype(int))
            is_fixed = np.isin(joints, recording.info.bones.fixed)
            rig = choose_references(rig, is_fixed, poses.pose_matrices[compared][:, joints])
    if not rig.has_weights:
        raise TrainingError(
            f"The vertices of '{rig.meshes[0].name}' follow no bone by skin weights, so there is no linear skinning to "
            "learn from; have one fitted (--base-skinning smooth, or Base Skinning in the sidebar), or paint weights "
            "and record again."
        )
    settings = config.min_vertices_per_part, config.influence_tolerance
    skinned = skin_recording(recording, rig, joints, follows, *settings, note=log)
    return replace(skinned, fit=fit, key_joints=choice.report if choice else None)


def keep_key_joints(recording: Recording, fitted_rig: Rig, joints: np.ndarray) -> Rig:
    """Return a rig with its key joints alone; its fingerprint describes the bones that follow these.

    Args:
        recording: the recording of the rig.
        fitted_rig: the rig with all joints and fitted skin weights.
        joints: (K,) ascending indices of the key joints.
    """
    bones, own_rig = recording.info.bones, recording.rig
    key_rig = select_joints(own_rig, joints_with_indices(own_rig, joints.tolist()))
    names = find_unread_bones(bones.sources, bones.controlled, own_rig, key_rig.joint_names)
    unread = {"unread_bones": {name: bones.settings[name] for name in names if name in bones.settings}}
    fingerprints = [
        replace(mesh.fingerprint, deformation=mesh.fingerprint.deformation | unread) for mesh in key_rig.meshes
    ]
    indices = np.zeros(len(own_rig.joints), np.int32)
    indices[joints] = np.arange(len(joints))
    return replace(
        key_rig,
        skin_joints=indices[fitted_rig.skin_joints],
        skin_weights=fitted_rig.skin_weights,
        meshes=tuple(replace(m, fingerprint=each) for m, each in zip(key_rig.meshes, fingerprints, strict=True)),
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
