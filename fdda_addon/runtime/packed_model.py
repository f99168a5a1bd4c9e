# SPDX-License-Identifier: GPL-3.0-or-later
"""Models inside the .blend file.

The bytes are a custom property of a text datablock, which nothing evaluates: on the mesh object they would be copied
whenever Blender copies the object for an evaluation. The text itself says to people what it is. The objects that use
the model point to it, so it comes along when they are appended or linked, and goes when the last of them goes.
"""

from pathlib import Path

import bpy

from ..core.errors import ModelError
from ..core.model import MAX_BYTES, check_model
from .network import Network

KEY = "fdda_model"
MAX_PROPERTY_BYTES = (1 << 31) - 1
"""A custom property holds no more."""

_networks: dict[int, Network] = {}


def pack(name: str, data: bytes) -> bpy.types.Text:
    """Put a model into the open file.

    Args:
        name: of the model.
        data: its bytes.

    Raises:
        ModelError: it is no model, or too large.
    """
    check_model(data, name)
    if len(data) > min(MAX_BYTES, MAX_PROPERTY_BYTES):
        raise ModelError(f"'{name}' is larger than 2 GB and cannot be packed; leave it beside the file.")
    text = bpy.data.texts.new(name)
    text.use_fake_user = False
    text.write(f"The FDDA model {name}, {len(data)} bytes, is kept in the custom property '{KEY}' of this text.\n")
    text[KEY] = data
    return text


def read(text: bpy.types.Text) -> bytes:
    """The bytes of a packed model, not checked.

    Raises:
        ModelError: the text holds none.
    """
    data = text.get(KEY)
    if not isinstance(data, bytes):
        raise ModelError(f"The text '{text.name}' does not hold a model any more; choose the model's file again.")
    return data


def load(text: bpy.types.Text) -> Network:
    """The network of a packed model, loaded once.

    Raises:
        ModelError: the text holds no model, or one that is refused.
    """
    if text.session_uid not in _networks:
        network = Network(Path(text.name), read(text))
        release_unused({other.session_uid for other in bpy.data.texts})
        _networks[text.session_uid] = network
    return _networks[text.session_uid]


def release_unused(used: set[int]) -> None:
    """Let go of the networks of all texts but those of some session ids."""
    for uid in _networks.keys() - used:
        del _networks[uid]


def remove_unused() -> None:
    """Remove the packed models that no object uses any more."""
    for text in [text for text in bpy.data.texts if KEY in text and text.users == 0]:
        bpy.data.texts.remove(text)
