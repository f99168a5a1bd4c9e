# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bound object keeps in the .blend file: `Object.fdda`."""

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

from . import evaluation_view, settings
from .scene.compatibility import BLEND_RELATIVE_PATH


def _apply(binding: "FDDA_PG_binding", _context: bpy.types.Context) -> None:
    from .runtime.binding import apply

    apply(binding.id_data)


class FDDA_PG_modifier(bpy.types.PropertyGroup):
    """A modifier of the rig and how it was shown before a model took its place."""

    uid: IntProperty()
    show_viewport: BoolProperty()
    show_render: BoolProperty()


class FDDA_PG_model(bpy.types.PropertyGroup):
    """A model of a mesh: its file, or the text that holds it."""

    name: StringProperty(name="Name", description="What the model is called")
    path: StringProperty(
        name="File",
        description="The model, an .onnx file; where it came from when it is packed",
        subtype="FILE_PATH",
        options=BLEND_RELATIVE_PATH,
    )
    packed: PointerProperty(
        name="Packed Model", description="The text that holds the model inside this file", type=bpy.types.Text
    )
    packed_bytes: IntProperty(name="Size", description="Size of the packed model in bytes")


class FDDA_PG_binding(bpy.types.PropertyGroup):
    """A model bound to a mesh object."""

    is_bound: BoolProperty(name="Bound", description="A model is bound to this object")
    model: StringProperty(
        name="Model",
        description="The model, an .onnx file",
        subtype="FILE_PATH",
        options=BLEND_RELATIVE_PATH,
    )
    packed: PointerProperty(
        name="Packed Model", description="The text that holds the model inside this file", type=bpy.types.Text
    )
    mode: EnumProperty(
        name="Mode",
        description="What deforms the mesh",
        items=(
            ("RIG", "Rig", "The modifiers of the rig"),
            ("LINEAR", "Linear Layer", "Linear skinning alone"),
            ("FDDA", "FDDA", "The model"),
        ),
        default="RIG",
        update=_apply,
    )
    strength: FloatProperty(
        name="Strength",
        description="0 is the linear layer, 1 the model",
        min=0,
        max=1,
        default=1,
        subtype="FACTOR",
        update=_apply,
    )
    use_in_render: BoolProperty(
        name="Use in Render", description="Final renders use the model as well, not the rig", update=_apply
    )
    status: StringProperty(name="Status", description="Why the model was switched off, empty when all is well")

    is_playing: BoolProperty(description="The modifiers of the rig are switched off and `modifiers` says how they were")
    modifiers: CollectionProperty(type=FDDA_PG_modifier)
    show_only_shape_key: BoolProperty()
    active_shape_key_index: IntProperty()

    models: CollectionProperty(type=FDDA_PG_model)
    model_index: IntProperty(name="Model", description="The model that the buttons below are about")

    settings: PointerProperty(type=settings.FDDA_PG_character)


CLASSES = (FDDA_PG_modifier, FDDA_PG_model, FDDA_PG_binding)


def register() -> None:
    settings.register()
    evaluation_view.register()
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Object.fdda = PointerProperty(type=FDDA_PG_binding)


def unregister() -> None:
    del bpy.types.Object.fdda
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
    evaluation_view.unregister()
    settings.unregister()
