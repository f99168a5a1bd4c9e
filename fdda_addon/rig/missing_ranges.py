# SPDX-License-Identifier: GPL-3.0-or-later
"""Describes numbers that deform a mesh and are no inputs of its model, because they have no range."""

from collections.abc import Collection

import bpy

from ..core.checks.warning import format_with_noun
from ..scene.controls import fcurve_target, is_driven, is_number
from ..scene.scene_rig import SceneRig
from .sources import TRANSFORM_PREFIXES, Sources


def describe_missing_ranges(
    scene_rig: SceneRig, sources: Sources, controls: Collection[tuple[bpy.types.ID, str, int]]
) -> str:
    """Describe the numbers that the drivers of a mesh read, and that no control and no driver sets.

    Args:
        sources: everything on which its mesh depends.
        controls: the controls of the model, in the form that `scene.controls.fcurve_target` returns.

    Returns:
        Sentences for the user; empty if there are no such numbers.
    """
    named, nameless = [], []
    for datablock, path in dict.fromkeys((*sources.numbers, *(read[1:] for read in sources.scene_reads))):
        # The places of objects on which the mesh depends are described as such (`independent_objects`).
        is_place = datablock in sources.objects and path.startswith(TRANSFORM_PREFIXES)
        is_input = fcurve_target(datablock, path) in controls
        if is_place or is_input or not is_number(datablock, path) or is_driven(datablock, path):
            continue
        if name := sources.control_name(datablock, path):
            named.append(name)
        else:
            nameless.append(f"{path} of {datablock.name}")
    mesh_name, sentences = scene_rig.mesh_object.name, []
    if named:
        sentences.append(
            f"The surface of '{mesh_name}' depends on {format_with_noun(named, 'number')} without a range, so the "
            "model keeps the value in the recording. Make it an input with a range: --control "
            f"'{named[0]}=LOW:HIGH', or Soft Min and Soft Max in the settings of the property."
        )
    if nameless:
        sentences.append(
            f"The surface of '{mesh_name}' depends on {format_with_noun(nameless, 'number')}, which cannot be an "
            "input, so the model keeps the value in the recording. Let the driver read a property of "
            f"'{scene_rig.armature_object.name}'."
        )
    return " ".join(sentences)
