# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits the weights of a folder of poses, and measures what that brings."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from fdda_addon.core.messages import MessageType
from fdda_addon.core.metrics import distances
from fdda_addon.core.recording.fit_folder import FitPoses, read_fit_poses, write_fitted_weights
from fdda_addon.core.rig import Rig
from fdda_addon.core.skin_fit import INFLUENCES, FitReport, SkinFit
from fdda_addon.core.skinning import LinearSkinning

from .announcements import Announcer
from .process import Cancelled
from .skin_solver import SkinSolver

BLOCK_FLOATS = 1 << 22
"""Positions are compared in blocks of so many coordinates."""


def fit_folder(
    folder: Path, kind: str, announcer: Announcer, should_stop: Callable[[], bool], metres_per_unit: float = 1.0
) -> SkinFit:
    """Fit the weights of a folder of poses, and write them into it. Every other pose is held out, to measure on.

    Args:
        folder: one that `FitPosesWriter` wrote.
        kind: one of `core.skin_fit.KINDS`.
        announcer: told the progress, and last what the fit brought.
        should_stop: asked often; nothing has been written when it is heeded.
        metres_per_unit: as in `Rig`.

    Raises:
        Cancelled: `should_stop` said so.
        FDDAError: the folder is damaged or cannot be written.
    """
    started = time.perf_counter()
    poses = read_fit_poses(folder)
    total = poses.rig.vertex_count
    training, held_out = poses.subset(slice(0, None, 2)), poses.subset(slice(1, None, 2))
    joints, weights = np.zeros((total, INFLUENCES), np.int32), np.zeros((total, INFLUENCES), np.float32)
    for block, *fitted in SkinSolver(training).fit(kind):
        if should_stop():
            raise Cancelled
        joints[block], weights[block] = fitted
        announcer.say(MessageType.PROGRESS, done=block.stop, total=total)
    skinned = replace(poses.rig, skin_joints=joints, skin_weights=weights, metres_per_unit=metres_per_unit)
    result = SkinFit(kind, len(poses.positions), *(measure(part, skinned) for part in (held_out, training)))
    write_fitted_weights(folder, joints, weights)
    announcer.say(MessageType.FINISHED, seconds=time.perf_counter() - started, fit=result.to_json())
    return result


def measure(poses: FitPoses, fitted: Rig) -> FitReport:
    """How far skinning with the rig's own and with the fitted weights is from the poses."""
    step, metres_per_unit = max(1, BLOCK_FLOATS // (3 * fitted.vertex_count)), fitted.metres_per_unit
    rms, largest = {}, {}
    for name, rig in (("rig", poses.rig), ("fitted", fitted)):
        skinning, squares, most = LinearSkinning(rig), 0.0, 0.0
        for start in range(0, len(poses.positions), step):
            part = slice(start, start + step)
            positions = skinning.positions(poses.pose_matrices[part])
            apart = distances(positions, poses.positions[part], metres_per_unit).astype(np.float64)
            squares, most = squares + float((apart**2).sum()), max(most, float(apart.max()))
        rms[name] = 1000 * (squares / (len(poses.positions) * fitted.vertex_count)) ** 0.5
        largest[name] = 1000 * most
    return FitReport(rms, largest)
