# SPDX-License-Identifier: GPL-3.0-or-later
"""Base class of operators on a rig: the active rig, or the rig of a named mesh object."""

import bpy

from ..core.errors import RigError
from ..scene.active_rig import active_rig, any_mesh_object, cached_active_rig, rigs_of_active_armature
from ..scene.scene_rig import SceneRig, armature_of


class RigOperator:
    """Mixin for an operator on a rig."""

    object: bpy.props.StringProperty(
        name="Object",
        description="Name of the mesh object. Empty for the active object",
        options={"SKIP_SAVE"},
    )
    all_meshes: bpy.props.BoolProperty(
        name="All Meshes",
        description="Apply to all meshes of the active armature",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def has_rig(cls, context: bpy.types.Context) -> bool:
        """Return whether the scene has a rig, else set the poll message. For `poll`.

        The rig need not be active: a script may name its object.
        """
        if cached_active_rig(context) is not None or any_mesh_object(context, armature_of):
            return True
        try:
            active_rig(context)
        except RigError as error:
            cls.poll_message_set(str(error).rstrip("."))
        return False

    def rig(self, context: bpy.types.Context) -> SceneRig:
        """Return the rig to apply the operator to.

        Raises:
            RigError: there is no rig.
        """
        return active_rig(context, self.object)

    def rigs(self, context: bpy.types.Context) -> list[SceneRig]:
        """Return the rigs to apply the operator to: with `all_meshes` all rigs of the active armature, else one rig.

        Raises:
            RigError: there is no rig.
        """
        together = rigs_of_active_armature(context) if self.all_meshes and not self.object else []
        return together or [self.rig(context)]

    def subject(self, context: bpy.types.Context) -> int:
        """Return the session_uid of the mesh object, for the state of a job."""
        return self.rig(context).mesh_object.session_uid
