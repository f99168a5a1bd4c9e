# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the pose setter of a rig or a target, and refuses poses that a target cannot show."""

from collections.abc import Iterable, Sequence

from ..core.controls import Control
from ..core.errors import RigError
from ..core.recording.target import FRAMES, POSE, SIMULATION
from ..poses.clip import Clip
from ..scene.scene_rig import SceneRig
from .pose_setter import DIRECT_POSE_SETTER, PoseSetter, TargetSettings
from .simulated_poses import Settler, SimulatedPoseSetter
from .target import Target, check_clips, find_target


def make_pose_setter(
    scene_rig: SceneRig,
    settings: TargetSettings,
    clips: Sequence[Clip],
    random_pose_count: int,
    controls: Iterable[Control] = (),
) -> PoseSetter:
    """Make the pose setter for a target, and check that the target can be used.

    Args:
        settings: settings of the target.
        clips: the clips whose frames are evaluated.
        random_pose_count: number of random poses.
        controls: the controls of the recording or the model.

    Raises:
        RigError: as `find_target` and `check_clips`, or the target cannot be set to these poses.
    """
    if not settings.name:
        if settings.pre_roll or settings.settle_frames:
            raise RigError("A pre-roll and settling need a target; name one, or leave both out.")
        return DIRECT_POSE_SETTER
    target = find_target(scene_rig, settings.name, controls)
    if random_pose_count and target.follows == FRAMES:
        raise RigError(
            f"The target '{target.name}' follows frames ({target.caches[0].description}), so it cannot show random "
            "poses; record 0 random poses, and the action that it was made with."
        )
    if random_pose_count and target.follows == SIMULATION and not settings.settle_frames:
        raise RigError(
            f"The target '{target.name}' is a simulation ({target.simulations[0].description}): what it shows in a "
            "random pose depends on the pose before; let it settle, or record 0 of them, and actions."
        )
    if settings.settle_frames and (target.follows != SIMULATION or any(not c.is_simulation for c in target.caches)):
        raise RigError(
            f"The target '{target.name}' cannot settle: {_reason_against_settling(target)}; leave settling out."
        )
    if settings.settle_frames and clips:
        raise RigError(
            f"Settled poses are random ones, and '{clips[0].name}' is to be recorded too, frame by frame; leave it "
            "out, or make a recording of each."
        )
    check_clips(target, clips, settings.pre_roll)
    settler = Settler(target, settings.settle_frames, settings.rest_threshold_mm) if settings.settle_frames else None
    if target.simulations:
        return SimulatedPoseSetter(target, settings.pre_roll, settler)
    return PoseSetter(target, settings.pre_roll)


def _reason_against_settling(target: Target) -> str:
    if target.follows == POSE:
        return "it follows the pose at once"
    cache = next(cache for cache in target.caches if not cache.is_simulation)
    return f"{cache.description} has a fixed range of frames"
