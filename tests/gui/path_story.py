# SPDX-License-Identifier: GPL-3.0-or-later
"""Story: from adding the sample arm to a saved file with a bound model.

The mouse presses the buttons of the add-on. Blender's own operators open and save files.
"""

import arm_steps
import evaluation_steps
import model_steps
import poses_steps

STEPS = (
    arm_steps.find_the_sidebar,
    arm_steps.add_the_arm,
    arm_steps.measure_the_rig,
    poses_steps.preview_a_random_pose,
    poses_steps.choose_the_bones_to_pose,
    poses_steps.set_the_number_of_poses,
    poses_steps.record,
    model_steps.check_the_trainer,
    model_steps.train,
    model_steps.bind,
    model_steps.switch_the_deformation,
    model_steps.measure_the_model,
    model_steps.play_the_action,
    evaluation_steps.evaluate,
    evaluation_steps.show_the_partitions,
    evaluation_steps.show_the_heat_map,
    evaluation_steps.jump_to_the_worst_frame,
    model_steps.unpack_and_pack_the_model,
    model_steps.unbind,
    model_steps.undo,
    model_steps.undo_while_posing,
    model_steps.save_and_open_again,
)
