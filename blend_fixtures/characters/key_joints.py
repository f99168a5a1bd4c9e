# SPDX-License-Identifier: GPL-3.0-or-later
"""Build limbs for the choice of key joints: one with bones that follow others, one whose bones all move freely."""

import bpy
import numpy as np

from blend_fixtures.elbow import END, START

from .bones import NewBone, add_bones, add_delta_mush, add_smooth_weights, limb

MAIN_BONES = ("bone.0", "bone.1", "bone.2")
HELPERS = ("half.1", "half.2", "push.1", "push.2")
"""Bones of `limb_with_helpers` that follow the main bones by a constraint or a driver."""


def limb_with_helpers() -> tuple[bpy.types.Object, bpy.types.Object]:
    """Build a limb with delta mush of three main bones; each joint has a half-rotating bone and a driven bone."""
    mesh_object, armature_object = limb(len(MAIN_BONES), 15.0, twist=20.0)
    ends = np.linspace(START, END, len(MAIN_BONES) + 1).tolist()
    for number in (1, 2):
        x_position, parent = ends[number], f"bone.{number - 1}"
        add_bones(
            armature_object,
            NewBone(f"half.{number}", (x_position, 0.0, 0.0), (x_position + 0.04, 0.0, 0.0), parent),
            NewBone(f"push.{number}", (x_position - 0.04, 0.0, 0.0), (x_position, 0.0, 0.0), parent),
        )
        copy = armature_object.pose.bones[f"half.{number}"].constraints.new("COPY_ROTATION")
        copy.target, copy.subtarget, copy.influence = armature_object, f"bone.{number}", 0.5
        copy.target_space = copy.owner_space = "LOCAL"
        driver = armature_object.driver_add(f'pose.bones["push.{number}"].location', 2).driver
        variable = driver.variables.new()
        variable.name = "bend"
        variable.targets[0].id = armature_object
        variable.targets[0].data_path = f'pose.bones["bone.{number}"].rotation_euler[0]'
        driver.expression = "0.03 * bend"
    add_smooth_weights(mesh_object, armature_object, 4, 0.05)
    add_delta_mush(mesh_object, 2)
    return mesh_object, armature_object


def limb_of_free_bones() -> tuple[bpy.types.Object, bpy.types.Object]:
    """Build a limb with delta mush of six bones that all move independently."""
    mesh_object, armature_object = limb(6, 30.0)
    add_smooth_weights(mesh_object, armature_object, 4, 0.05)
    add_delta_mush(mesh_object, 2)
    return mesh_object, armature_object
