# SPDX-License-Identifier: GPL-3.0-or-later
"""Build characters that animators pose with control bones; each function builds one from the tube of `base`.

The control bones are in the bone collection `Controls`.
"""

from .base import add_key, bulge, drive, tube
from .bones import NewBone, add_bone_collection, add_bones, add_delta_mush, limit, remove_constraints
from .controls import add_property

CONTROLS = "Controls"


def ik_fk() -> None:
    """Build an arm with delta mush whose deforming bones copy an FK and an IK chain; a custom property blends both."""
    mesh_object, armature_object = tube()
    start, joint, end = (0.0, 0.0, 0.0), (0.25, 0.0, 0.0), (0.5, 0.0, 0.0)
    add_bones(
        armature_object,
        *(
            bone
            for chain in ("fk", "ik")
            for bone in (
                NewBone(f"{chain}_upper", start, joint, is_deforming=False),
                NewBone(f"{chain}_lower", joint, end, f"{chain}_upper", is_deforming=False, is_connected=True),
            )
        ),
        NewBone("ik_hand", end, (0.6, 0.0, 0.0), is_deforming=False),
        NewBone("ik_pole", (0.25, -0.4, 0.0), (0.25, -0.5, 0.0), is_deforming=False),
    )
    bones = armature_object.pose.bones
    limit(bones["fk_upper"], "LIMIT_ROTATION", {axis: (-45.0, 45.0) for axis in range(3)})
    limit(bones["fk_lower"], "LIMIT_ROTATION", {0: (0.0, 120.0)})
    # The hand stays so near that the arm is never straight: a straight arm does not follow the pole.
    limit(bones["ik_hand"], "LIMIT_LOCATION", {0: (-0.12, 0.12), 1: (-0.25, -0.05), 2: (-0.12, 0.12)})
    limit(bones["ik_pole"], "LIMIT_LOCATION", {0: (-0.15, 0.15)})
    bones["ik_lower"].lock_rotation = bones["ik_upper"].lock_rotation = (False, False, False)
    ik = bones["ik_lower"].constraints.new("IK")
    ik.target = ik.pole_target = armature_object
    ik.subtarget, ik.pole_subtarget, ik.chain_count = "ik_hand", "ik_pole", 2
    add_property(armature_object, "ik")
    for name in ("upper", "lower"):
        remove_constraints(bones[name])
        for chain in ("fk", "ik"):
            copy = bones[name].constraints.new("COPY_TRANSFORMS")
            copy.name, copy.target, copy.subtarget = chain, armature_object, f"{chain}_{name}"
        drive(bones[name].constraints["ik"], "influence", armature_object, '["ik"]')
    add_bone_collection(armature_object, CONTROLS, "fk_upper", "fk_lower", "ik_hand", "ik_pole")
    add_delta_mush(mesh_object)


def face_slider() -> None:
    """Build a face with a slider bone that drives a shape key, and a control bone that rotates the jaw."""
    mesh_object, armature_object = tube()
    add_bones(
        armature_object,
        NewBone("slider", (0.25, 0.0, 0.3), (0.25, 0.0, 0.35), is_deforming=False),
        NewBone("jaw", (0.25, 0.0, 0.0), (0.25, -0.2, 0.0), "upper", is_deforming=False),
    )
    bones = armature_object.pose.bones
    limit(bones["slider"], "LIMIT_LOCATION", {1: (0.0, 0.1)})
    limit(bones["jaw"], "LIMIT_ROTATION", {2: (0.0, 60.0)})
    remove_constraints(bones["lower"])
    child_target = bones["lower"].constraints.new("ARMATURE").targets.new()
    child_target.target, child_target.subtarget = armature_object, "jaw"
    drive(add_key(mesh_object, "smile", bulge), "value", armature_object, ("slider", "LOC_Y"), "10 * value")
    add_bone_collection(armature_object, CONTROLS, "slider", "jaw")
    add_delta_mush(mesh_object)
