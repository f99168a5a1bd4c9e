# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that work on a rig: the active one, or that of a mesh object by its name."""

import bpy

from ..core.errors import RigError
from ..scene.active_rig import active_rig
from ..scene.scene_rig import SceneRig, armature_of


class OnRig:
    """Mixin for an operator that works on a rig."""

    object: bpy.props.StringProperty(
        name="Object",
        description="Name of the mesh object; empty for the active object",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def has_rig(cls, context: bpy.types.Context) -> bool:
        """Whether there is a rig to work on; sets the poll message otherwise. For `poll`.

        A rig anywhere in the scene will do: a script may name its object.
        """
        try:
            active_rig(context)
        except RigError as error:
            if any(o.type == "MESH" and armature_of(o) is not None for o in context.scene.objects):
                return True
            cls.poll_message_set(str(error).rstrip("."))
            return False
        return True

    def rig(self, context: bpy.types.Context) -> SceneRig:
        """The rig that is meant.

        Raises:
            RigError: there is none, or it is not clear which is meant.
        """
        return active_rig(context, self.object)

    def subject(self, context: bpy.types.Context) -> str:
        """Name of the mesh object, for the state of a job."""
        return self.rig(context).mesh_object.name
