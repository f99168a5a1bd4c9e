# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits skin weights to a folder of poses, and measures the improvement."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from fdda_addon.core.formats.messages import MessageType
from fdda_addon.core.joint_option import ALL, KEY_JOINTS_STAGE
from fdda_addon.core.mathematics.metrics import distances
from fdda_addon.core.mathematics.skin_fit import FitReport, SkinFit
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.fit_folder import FitPoses, read_fit_poses, write_fitted_weights, write_key_joints
from fdda_addon.core.rig import Rig

from ..blocks import block_slices
from ..progress import MessageSink
from .choice import choose_key_joints
from .solver import fit_skin


def fit_folder(
    folder: Path,
    kind: str,
    sink: MessageSink,
    metres_per_unit: float = 1.0,
    joints: str = ALL,
    random_poses: int = 0,
    static_joint: int = -1,
) -> SkinFit | None:
    """Fit skin weights to a folder of poses, and write them into it. Every other pose is held out to measure the error.

    Args:
        folder: written by `FitPosesWriter`.
        kind: one of `core.mathematics.skin_fit.FIT_KINDS`.
        sink: receives progress, and last the result.
        metres_per_unit: as in `Rig`.
        joints: the joints that may have weights: the option `joints`, "all", "auto", or a number.
        random_poses: number of random poses, which come first; key joints are chosen by these.
        static_joint: index of the static joint; -1 if there is none.

    Returns:
        The result; None if key joints were requested, but no joint can be removed. Then nothing is written.

    Raises:
        FDDAError: the folder is damaged or cannot be written.
    """
    started = time.perf_counter()
    poses = read_fit_poses(folder)
    choice = None
    if joints != ALL:
        is_static = np.arange(len(poses.rig.joints)) == static_joint
        choice = choose_key_joints(
            poses,
            random_poses,
            joints,
            is_static,
            metres_per_unit,
            lambda done, total: sink.send(MessageType.PROGRESS, stage=KEY_JOINTS_STAGE, done=done, total=total),
        )
    if choice and len(choice.joints) == len(poses.rig.joints):
        values = {"fit": None, "key_joints": choice.report.to_json()}
        sink.send(MessageType.FINISHED, seconds=time.perf_counter() - started, **values)
        return None
    training, held_out = poses.subset(slice(0, None, 2)), poses.subset(slice(1, None, 2))
    fitted_joints, weights = fit_skin(
        training.with_joints(choice.weighted_joints) if choice else training,
        kind,
        lambda done: sink.send(MessageType.PROGRESS, done=done, total=poses.rig.vertex_count),
    )
    if choice:
        fitted_joints = choice.weighted_joints[fitted_joints].astype(np.int32)
    skinned = replace(poses.rig, skin_joints=fitted_joints, skin_weights=weights, metres_per_unit=metres_per_unit)
    reports = measure(held_out, skinned), measure(training, skinned)
    result = SkinFit(kind, len(poses.positions), *reports, choice.report if choice else None)
    write_fitted_weights(folder, fitted_joints, weights)
    if choice:
        write_key_joints(folder, choice.joints, choice.needed_inputs)
    sink.send(MessageType.FINISHED, seconds=time.perf_counter() - started, fit=result.to_json())
    return result


def measure(poses: FitPoses, fitted: Rig) -> FitReport:
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
