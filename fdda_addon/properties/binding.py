# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties of a mesh object that has a model: `Object.fdda`, which is saved in the .blend file."""

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..runtime.binding import on_mask_update, on_property_update
from ..scene import draw_cache
from .character import FDDA_PG_character, not_animatable

OVERRIDABLE = {"LIBRARY_OVERRIDABLE"}
"""Options of properties that a library override may change. Blender resets all others."""
INSERTABLE = OVERRIDABLE | {"USE_INSERTION"}
"""Options of collections to which a library override may add entries."""


def _on_update(binding: "FDDA_PG_binding", _context: bpy.types.Context) -> None:
    on_property_update(binding.id_data)


def _on_mask_update(binding: "FDDA_PG_binding", _context: bpy.types.Context) -> None:
    on_mask_update(binding.id_data)


@not_animatable
class FDDA_PG_modifier(bpy.types.PropertyGroup):
    """Visibility of a modifier of the rig before the model replaced it."""

    uid: IntProperty(override=OVERRIDABLE)
    show_viewport: BoolProperty(override=OVERRIDABLE)
    show_render: BoolProperty(override=OVERRIDABLE)


@not_animatable
class FDDA_PG_model(bpy.types.PropertyGroup):
    """A model of the Model Library, stored in a file or packed in a text datablock."""

    name: StringProperty(name="Name", description="Name of the model", override=OVERRIDABLE)
    path: StringProperty(
        name="File",
        description="The model, an .onnx file; where it came from when it is packed",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
        override=OVERRIDABLE,
    )
    packed: PointerProperty(
        name="Packed Model",
        description="The text that holds the model inside this file",
        type=bpy.types.Text,
        override=OVERRIDABLE,
    )
    packed_bytes: IntProperty(name="Size", description="Size of the packed model in bytes", override=OVERRIDABLE)


@not_animatable
class FDDA_PG_binding(bpy.types.PropertyGroup):
    """The model that is bound to a mesh object, its Model Library, and the settings of the character."""

    is_bound: BoolProperty(name="Bound", description="A model is bound to this object", override=OVERRIDABLE)
    model: StringProperty(
        name="Model",
        description="The model, an .onnx file",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
        override=OVERRIDABLE,
    )
    packed: PointerProperty(
        name="Packed Model",
        description="The text that holds the model inside this file",
        type=bpy.types.Text,
        override=OVERRIDABLE,
    )
    in_model: BoolProperty(
        name="In the Model",
        description=(
            "Record, train and bind this mesh together with the other checked meshes of its armature. An unchecked "
            "mesh is left out; select it to give it a model of its own"
        ),
        default=True,
        update=lambda _binding, _context: draw_cache.clear(),
        override=OVERRIDABLE,
    )
    model_mesh: StringProperty(name="Mesh", description="Name of this mesh in the model", override=OVERRIDABLE)
    armature: PointerProperty(
        name="Armature",
        description="The armature of a mesh without an Armature modifier",
        type=bpy.types.Object,
        override=OVERRIDABLE,
    )
    mode: EnumProperty(
        name="Mode",
        description="What deforms the mesh",
        items=(
            ("RIG", "Rig", "The modifiers of the rig"),
            ("LINEAR", "Skinning", "Linear skinning alone"),
            ("FDDA", "Model", "The model"),
        ),
        default="RIG",
        update=_on_update,
        options={"ANIMATABLE"},
        override=OVERRIDABLE,
    )
    strength: FloatProperty(
        name="Strength",
        description="Blend from linear skinning (0) to the model (1)",
        min=0,
        max=1,
        default=1,
        subtype="FACTOR",
        update=_on_update,
        options={"ANIMATABLE"},
        override=OVERRIDABLE,
    )
    mask: StringProperty(
        name="Mask",
        description=(
            "Vertex group that limits the model: at a weight of 1 the model is used, at 0 and outside the group linear "
            "skinning, in between a blend. Empty to use the model everywhere"
        ),
        update=_on_mask_update,
        override=OVERRIDABLE,
    )
    invert_mask: BoolProperty(
        name="Invert Mask",
        description="Use the model outside the vertex group instead of inside",
        update=_on_mask_update,
        override=OVERRIDABLE,
    )
    use_in_render: BoolProperty(
        name="Use in Render",
        description="Use the model in final renders too, instead of the rig",
        update=_on_update,
        override=OVERRIDABLE,
    )
    status: StringProperty(
        name="Status", description="Why the model is switched off; empty when it is not", override=OVERRIDABLE
    )

    # Not overridable: when a library is relocated to the full rig, nothing of the fast rig may remain.
    is_fast_rig: BoolProperty(
        name="Fast Rig", description="The armature lacks the bones that neither the model nor the controls need"
    )
    is_playing: BoolProperty(
        description="The modifiers of the rig are off, and `modifiers` stores their former visibility",
        override=OVERRIDABLE,
    )
    modifiers: CollectionProperty(type=FDDA_PG_modifier, override=INSERTABLE)
    adds_rest_position: BoolProperty(
        description="Add Rest Position was on before the model replaced the modifiers", override=OVERRIDABLE
    )

    models: CollectionProperty(type=FDDA_PG_model, override=INSERTABLE)
    model_index: IntProperty(name="Model", description="Active model of the list", override=OVERRIDABLE)

    settings: PointerProperty(type=FDDA_PG_character, override=OVERRIDABLE)


CLASSES = (FDDA_PG_modifier, FDDA_PG_model, FDDA_PG_binding)
PROPERTIES = {(bpy.types.Object, "fdda"): PointerProperty(type=FDDA_PG_binding, override=OVERRIDABLE)}
