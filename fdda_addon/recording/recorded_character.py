# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the mesh objects of a recording in the scene."""

from pathlib import Path

from ..core.recording.index import read_index
from ..scene.scene_rig import SceneRig, find_character, find_rig


def find_recorded_character(path: Path, object_name: str = "") -> SceneRig:
    """Find the rig of the meshes of a recording.

    Args:
        path: folder of the recording.
        object_name: name of the mesh object of a recording of one mesh; several meshes have their recorded names.
    """
    names = [mesh["name"] for mesh in read_index(path)["meshes"]]
    return find_character(names) if len(names) > 1 else find_rig(object_name)
