# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters that animators pose with control bones: one function each, which builds a tube as in `base`.

What animators pose is in the bone collection `Controls`.
"""

from collections.abc import Callable

from .base import bulge, tube
from .bones import NewBone, add_bones, free, in_collection, limit, mush
from .controls import add_key, add_property, follow

CONTROLS = "Controls"


def ik_fk() -> None:
    """An arm that blends from FK to IK with a custom property; deforming bones copy both chains. Delta mush."""
    mesh_object, armature_object = tube()
    start, joint, end = (0.0, 0.0, 0.0), (0.25, 0.0, 0.0), (0.5, 0.0, 0.0)
    add_bones(
        armature_object,
        *(
            bone
            for way in ("fk", "ik")
            for bone in (
                NewBone(f"{way}_upper", start, joint, is_deforming=False),
                NewBone(f"{way}_lower", joint, end, f"{way}_upper", is_deforming=False, is_connected=True),
            )
        ),
        NewBone("ik_hand", end, (0.6, 0.0, 0.0), is_deforming=False),
        NewBone("ik_pole", (0.25, -0.4, 0.0), (0.25, -0.5, 0.0), is_deforming=False),
    )
    bones = armature_object.pose.bones
    limit(bones["fk_upper"], "LIMIT_ROTATION", {axis: (-45.0, 45.0) for axis in range(3)})
    limit(bones["fk_lower"], "LIMIT_ROTATION", {0: (0.0, 120.0)})
    # Nearer than the arm is long, and never straight: the pole decides where the elbow goes.
    limit(bones["ik_hand"], "LIMIT_LOCATION", {0: (-0.12, 0.12), 1: (-0.25, -0.05), 2: (-0.12, 0.12)})
    limit(bones["ik_pole"], "LIMIT_LOCATION", {0: (-0.15, 0.15)})
    bones["ik_lower"].lock_rotation = bones["ik_upper"].lock_rotation = (False, False, False)
    ik = bones["ik_lower"].constraints.new("IK")
    ik.target = ik.pole_target = armature_object
    ik.subtarget, ik.pole_subtarget, ik.chain_count = "ik_hand", "ik_pole", 2
    add_property(armature_object, "ik")
    for name in ("upper", "lower"):
        free(bones[name])
        for way in ("fk", "ik"):
            copy = bones[name].constraints.new("COPY_TRANSFORMS")
            copy.name, copy.target, copy.subtarget = way, armature_object, f"{way}_{name}"
        follow(bones[name].constraints["ik"], "influence", armature_object, '["ik"]')
    in_collection(armature_object, CONTROLS, "fk_upper", "fk_lower", "ik_hand", "ik_pole")
    mush(mesh_object)


def face_slider() -> None:
    """A slider beside a face: a bone that moves along Z, and drives a shape key; a control bone turns the jaw."""
    mesh_object, armature_object = tube()
    add_bones(
        armature_object,
        NewBone("slider", (0.25, 0.0, 0.3), (0.25, 0.0, 0.35), is_deforming=False),
        NewBone("jaw", (0.25, 0.0, 0.0), (0.25, -0.2, 0.0), "upper", is_deforming=False),
    )
    bones = armature_object.pose.bones
    limit(bones["slider"], "LIMIT_LOCATION", {1: (0.0, 0.1)})
    limit(bones["jaw"], "LIMIT_ROTATION", {2: (0.0, 60.0)})
    free(bones["lower"])
    child = bones["lower"].constraints.new("ARMATURE").targets.new()
    child.target, child.subtarget = armature_object, "jaw"
    smile = add_key(mesh_object, "smile", bulge)
    driver = smile.driver_add("value").driver
    variable = driver.variables.new()
    variable.name, variable.type = "place", "TRANSFORMS"
    target = variable.targets[0]
    target.id, target.bone_target = armature_object, "slider"
    target.transform_type, target.transform_space = "LOC_Y", "LOCAL_SPACE"
    driver.expression = "10 * place"
    in_collection(armature_object, CONTROLS, "slider", "jaw")
    mush(mesh_object)


CONTROL_RIGS: tuple[Callable[[], None], ...] = (ik_fk, face_slider)
