# SPDX-License-Identifier: GPL-3.0-or-later
"""Detects the joints and controls that influence each partition (Bailey et al. 2018, section 3.3).

Each input is moved alone, from the rest pose and from random poses, to a value far from its own in that pose.
"""

from collections.abc import Generator

import numpy as np

from ..core.checks.warning import joint_name
from ..core.mathematics.features import FLOAT32_ROUNDING_RATIO
from ..core.mathematics.partition import Partition, make_partitions
from ..core.mathematics.poses import CONTROL
from ..core.mathematics.skinning import LinearSkinning
from ..core.progress import Progress
from ..core.rig import Rig
from ..rig.reading import PoseEvaluator
from ..rig.shape_keys import key_distances, muted_key_drivers
from ..scene.bone_transform import controls_by_bone
from ..scene.scene_rig import SceneRig
from .influence_trials import JOINT, InfluenceSearch, prepared_trials

BATCH_BYTES = 6 << 20
"""Bytes of the positions of a batch of inputs whose residuals are computed together."""


def detect_influences(
    scene_rig: SceneRig, rig: Rig, partitions: tuple[Partition, ...], evaluator: PoseEvaluator, search: InfluenceSearch
) -> Generator[Progress, None, tuple[Partition, ...]]:
    """Detect the influences on the partitions of a rig while the generator is iterated.

    The caller restores the pose of the armature and the values of sampled controls.

    Yields:
        Progress of the stage "influences", one for each evaluation.

    Returns:
        The partitions with their influencing joints and controls.
    """
    skinning = LinearSkinning(rig, partitions)
    # Far from the origin, rounding moves vertices, so the threshold must be larger.
    rounding = FLOAT32_ROUNDING_RATIO * float(np.abs(rig.rest_positions).max())
    threshold = max(search.tolerance * rig.size, 2 * rounding)
    batch_size = max(1, BATCH_BYTES // (12 * rig.vertex_count))
    infinite_tests = []
    # The effect of shape keys is that of their values, not of the joints that drive these.
    with muted_key_drivers(scene_rig.mesh_object), prepared_trials(scene_rig, rig, search) as trials:
        inputs = trials.inputs
        influences = np.zeros((len(inputs), len(partitions)), bool)
        done, total = 0, search.poses * (len(inputs) + 1) if inputs else 1
        for trial in range(search.poses if inputs else 0):
            trials.show(trial, None)
            poses = [evaluator.evaluate()[:2]]
            base = skinning.local_residuals(*map(np.stack, zip(*poses, strict=True)))
            yield Progress("influences", done := done + 1, total)
            for start in range(0, len(inputs), batch_size):
                batch, poses = range(start, min(start + batch_size, len(inputs))), []
                for number in batch:
                    trials.show(trial, number)
                    poses.append(evaluator.evaluate()[:2])
                    yield Progress("influences", done := done + 1, total)
                changes = skinning.local_residuals(*map(np.stack, zip(*poses, strict=True))) - base
                norms = np.linalg.norm(changes, axis=2)
                # A position that stops being finite is influenced; one that is not finite in the base pose is unknown.
                is_infinite = ~np.isfinite(norms) & np.isfinite(base).all(axis=2)
                infinite_tests += [(trial, batch[index]) for index in np.flatnonzero(is_infinite.any(axis=1))]
                is_changed = (norms > threshold) | is_infinite
                for index, partition in enumerate(partitions):
                    influences[batch, index] |= is_changed[:, partition.vertices].any(axis=1)
        undetectable_controls = trials.undetectable_controls
    if infinite_tests:
        trial, number = infinite_tests[0]
        kind, index = inputs[number]
        name = joint_name(rig, index) if kind == JOINT else rig.controls[index].name
        note = (
            f"Some positions of '{scene_rig.mesh_object.name}' are not finite in {len(infinite_tests)} tests of its "
            f"influences, as when '{name}' moves from {f'random pose {trial}' if trial else 'the rest pose'}; that "
            "counts as an influence. Look for a constraint, driver or modifier that fails in extreme poses."
        )
        yield Progress("influences", done, total, note)
    distances_of_keys = key_distances(scene_rig.mesh_object)
    # The first control of a bone stands for all controls of its transform.
    controls_of_bones = {indices[0]: indices for indices in controls_by_bone(rig.controls).values()}
    by_kind: dict[str, dict[int, tuple[int, ...]]] = {JOINT: {}, CONTROL: {}}
    for partition, is_influence in zip(partitions, influences.T, strict=True):
        partition_inputs = {inputs[number] for number in np.flatnonzero(is_influence)}
        controls = {index for kind, index in partition_inputs if kind == CONTROL} & controls_of_bones.keys()
        partition_inputs |= {(CONTROL, index) for control in controls for index in controls_of_bones[control]}
        partition_inputs |= {(CONTROL, control) for control in undetectable_controls}
        partition_inputs |= {
            (CONTROL, index)
            for index, control in enumerate(rig.controls)
            if control.is_shape_key
            and (search.has_target or (distances_of_keys[control.path][partition.vertices] > threshold).any())
        }
        for kind, by_joint in by_kind.items():
            by_joint[partition.joint] = tuple(sorted(index for each, index in partition_inputs if each == kind))
    main_joints_of_merged = {joint: partition.joint for partition in partitions for joint in partition.merged}
    return make_partitions(rig, by_kind[JOINT], by_kind[CONTROL], main_joints_of_merged)
