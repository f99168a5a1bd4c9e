# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that damage a recording, and a check of the error message when it is read."""

import json
import struct

import pytest

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.recording.reader import read_recording


def assert_refused(path, *phrases: str) -> None:
    """Check that reading the recording fails with one sentence that contains all phrases."""
    with pytest.raises(RecordingError) as error:
        read_recording(path)
    for phrase in phrases:
        assert phrase in str(error.value)
    assert str(error.value).endswith(".") and "\n" not in str(error.value)


def edit_index(path, **changes) -> dict:
    """Change keys of recording.json and return the changed index."""
    index = json.loads((path / "recording.json").read_text())
    index.update(changes)
    (path / "recording.json").write_text(json.dumps(index))
    return index


def npy_bytes(header: str | bytes, body: bytes = b"", version: bytes = b"\x01\x00") -> bytes:
    """Return the bytes of an npy file with any text or bytes as its header."""
    header = header.encode() if isinstance(header, str) else header
    return b"\x93NUMPY" + version + struct.pack("<H", len(header)) + header + body
