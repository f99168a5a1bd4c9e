# SPDX-License-Identifier: GPL-3.0-or-later
"""Build characters with as many shape keys as productions have: ARKit's 52, 300, and 60 that joints drive.

`python -m blend_fixtures.characters.shape_keys arkit|many|correctives OUT.blend` saves one of them. The heads are that
of `face` with two bones, and have an action; the correctives are on the sample arm, which has one.
"""

import sys
from pathlib import Path

import bpy
import numpy as np

from fdda_addon.arm.rig import build_arm

from .base import add_key, drive
from .bones import NewBone, add_bones, limit
from .face import PART_ANGLES, add_groups, add_head, add_performance, lower_face, move_near

SIDES = ("Left", "Right")
ARKIT_PARTS = {
    **{f"{name}{side}": f"{part}.{side[0]}" for side in SIDES for name, part in (
        ("browDown", "brow_in"), ("browOuterUp", "brow_out"), ("cheekSquint", "cheek"), ("eyeBlink", "lid_top"),
        ("eyeLookDown", "lid_bottom"), ("eyeLookIn", "lid_top"), ("eyeLookOut", "lid_bottom"), ("eyeLookUp", "lid_top"),
        ("eyeSquint", "lid_bottom"), ("eyeWide", "lid_top"), ("mouthDimple", "corner"), ("mouthFrown", "corner"),
        ("mouthLowerDown", "lip_bottom"), ("mouthPress", "lip_bottom"), ("mouthSmile", "corner"),
        ("mouthStretch", "corner"), ("mouthUpperUp", "lip_top"),
    )},
    "browInnerUp": "brow_in.L", "cheekPuff": "cheek.L", "jawForward": "chin", "jawLeft": "chin", "jawOpen": "jaw",
    "jawRight": "chin", "mouthClose": "lip_bottom", "mouthFunnel": "lip_top", "mouthLeft": "corner.L",
    "mouthPucker": "lip_top", "mouthRight": "corner.R", "mouthRollLower": "lip_bottom", "mouthRollUpper": "lip_top",
    "mouthShrugLower": "chin", "mouthShrugUpper": "lip_top", "noseSneerLeft": "nose", "noseSneerRight": "nose",
    "tongueOut": "lip_bottom",
}  # fmt: skip
"""The 52 blend shapes of ARKit, and the part of the face near which each one moves the vertices."""


def arkit_face() -> None:
    """Build the head with ARKit's 52 shape keys, which an animator or a capture sets."""
    _build_head(ARKIT_PARTS)


def many_keys() -> None:
    """Build the head with 300 shape keys, each near a part of the face."""
    parts = list(PART_ANGLES)
    _build_head({f"key.{index:03}": parts[index % len(parts)] for index in range(300)})


def _build_head(parts: dict[str, str]) -> None:
    """Build a head, skull and jaw as bones, with a shape key near a part of the face for each name."""
    mesh_object, armature_object, points = add_head()
    add_bones(
        armature_object,
        NewBone("head", (0.0, 0.02, -0.12), (0.0, 0.02, 0.1)),
        NewBone("jaw", (0.0, 0.03, 0.0), (0.0, -0.09, -0.06), "head"),
    )
    limit(armature_object.pose.bones["head"], "LIMIT_ROTATION", {0: (-20.0, 20.0), 1: (-30.0, 30.0)})
    limit(armature_object.pose.bones["jaw"], "LIMIT_ROTATION", {0: (-25.0, 0.0)})
    weights = lower_face(points)
    add_groups(mesh_object, {"jaw": weights, "head": 1 - weights})
    random = np.random.default_rng(0)
    for name, part in parts.items():
        add_key(mesh_object, name, move_near(part, tuple(random.uniform(-6, 6, 3)), random.uniform(0.08, 0.25)))
    add_performance(mesh_object, "performance")


def corrected_arm() -> None:
    """Build the sample arm with 60 corrective shape keys that angles of joints drive, clamped to 0 and 1."""
    mesh_object, armature_object = build_arm()
    points = np.array([vertex.co for vertex in mesh_object.data.vertices])
    axes = [(bone, axis) for axis in range(3) for bone in armature_object.pose.bones if not bone.lock_rotation[axis]]
    random = np.random.default_rng(0)
    for index in range(60):
        bone, axis = axes[index % len(axes)]
        center = points[np.argmin(np.linalg.norm(points - bone.bone.head_local, axis=1))]
        offset, radius = random.uniform(-0.004, 0.004, 3), random.uniform(0.02, 0.06)

        def bulge(at: np.ndarray, center=center, offset=offset, radius=radius) -> np.ndarray:
            return at + np.exp(-(((at - center) / radius) ** 2).sum(axis=1))[:, None] * offset

        key, channel = add_key(mesh_object, f"{bone.name}_{index:02}", bulge), f"ROT_{'XYZ'[axis]}"
        expression = f"min(1, max(0, {random.choice([-1.5, 1.5])} * value))"
        drive(key, "value", armature_object, (bone.name, channel), expression)


def main(name: str, output_path: Path) -> None:
    """Build a character, and save it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    {"arkit": arkit_face, "many": many_keys, "correctives": corrected_arm}[name]()
    bpy.ops.wm.save_as_mainfile(filepath=str(output_path.absolute()), copy=True)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
