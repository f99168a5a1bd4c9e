# SPDX-License-Identifier: GPL-3.0-or-later
"""Ways to damage a recording, and what reading it must then say."""

import json
import struct

import pytest

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.recording.reader import read_recording


def refused(path, *words: str) -> None:
    with pytest.raises(RecordingError) as error:
        read_recording(path)
    for word in words:
        assert word in str(error.value)
    assert str(error.value).endswith(".") and "\n" not in str(error.value)


def edit(path, **changes) -> dict:
    """Change the index; returns it."""
    index = json.loads((path / "recording.json").read_text())
    index.update(changes)
    (path / "recording.json").write_text(json.dumps(index))
    return index


def array_file(header: str | bytes, body: bytes = b"", version: bytes = b"\x01\x00") -> bytes:
    """The bytes of an npy file with any text as its header."""
    header = header.encode() if isinstance(header, str) else header
    return b"\x93NUMPY" + version + struct.pack("<H", len(header)) + header + body
