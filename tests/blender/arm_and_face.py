# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters with control bones and free shape keys, saved and active, and their recordings."""

from pathlib import Path

import bpy

from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.properties.character import recording_folder
from fdda_addon.scene.scene_rig import SceneRig, find_rig

IK = 'armature_object/["ik"]'


def saved(tmp_path: Path) -> SceneRig:
    """Save the file, make the character active and set 6 poses to record; return its rig."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "rig.blend"))
    rig = find_rig()
    bpy.context.view_layer.objects.active = rig.mesh_object
    rig.mesh_object.fdda.settings.poses = 6
    return rig


def recorded(rig: SceneRig) -> Recording:
    assert bpy.ops.fdda.record() == {"FINISHED"}
    return read_recording(recording_folder(rig.mesh_object))
