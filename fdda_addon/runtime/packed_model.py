# SPDX-License-Identifier: GPL-3.0-or-later
"""Packs models into the .blend file.

The bytes are a custom property of a text datablock, because Blender never evaluates texts. A custom property of a mesh
object would be copied with each evaluated copy. The text itself says where its model is. The objects that use the model
point to the text, so Blender appends and links it with them, and removes it with the last object.
"""

import bpy

from ..core.errors import ModelError
from ..core.formats.model import check_model
from .session import session

PACKED_MODEL_KEY = "fdda_model"
"""Custom property of a text datablock that holds a model."""


def pack(name: str, data: bytes) -> bpy.types.Text:
    """Pack a model into the open file, unless it is there already.

    Args:
        name: name of the model.
        data: bytes of the model.

    Returns:
        The text datablock.

    Raises:
        ModelError: the bytes are not a model, or too large.
    """
    # No model is as large as Blender's limit for a custom property, 2 GB.
    check_model(data, name)
    # The meshes of a character share a packed model.
    for text in bpy.data.texts:
        if text.library is None and text.get(PACKED_MODEL_KEY) == data:
            return text
    text = bpy.data.texts.new(name)
    text.use_fake_user = False
    text.write(
        f"The FDDA model {name}, {len(data)} bytes, is stored in the custom property '{PACKED_MODEL_KEY}' of this "
        "text.\n"
    )
    text[PACKED_MODEL_KEY] = data
    return text


def read(text: bpy.types.Text) -> bytes:
    """Return the bytes of a packed model without checking them.

    Raises:
        ModelError: the text holds no model.
    """
    data = text.get(PACKED_MODEL_KEY)
    if not isinstance(data, bytes):
        raise ModelError(f"The text '{text.name}' does not hold a model any more; choose the model's file again.")
    return data


def remove_unused_texts() -> None:
    """Remove the text datablocks of models that no object uses any more, and free these models."""
    for text in [text for text in bpy.data.texts if PACKED_MODEL_KEY in text and text.users == 0]:
        session.networks.pop(text.session_uid, None)
        bpy.data.texts.remove(text)
