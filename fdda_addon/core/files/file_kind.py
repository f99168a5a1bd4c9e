# SPDX-License-Identifier: GPL-3.0-or-later
"""Kinds of output files, recognized by their signatures, so that a file of another kind is not overwritten."""

import re
from dataclasses import dataclass
from pathlib import Path

from .input_file import open_input

SIGNATURE_BYTES = 4096


@dataclass(frozen=True)
class FileKind:
    """A kind of output file.

    Attributes:
        name: name of the kind in messages, with its article.
        signature: regular expression that matches the first bytes of such a file.
    """

    name: str
    signature: bytes

    def matches(self, path: Path) -> bool:
        """Return whether a file is of this kind; an empty file is of every kind."""
        with open_input(path) as file:
            first_bytes = file.read(SIGNATURE_BYTES)
        return not first_bytes or re.match(self.signature, first_bytes, re.DOTALL) is not None


_OBJECTS_PREFIX = rb'\s*\{\s*(?:"objects":\s*\{\s*"(?:[^"\\]|\\.)*":\s*\{\s*)?'

BLEND = FileKind("a .blend file", rb"BLENDER|\x28\xb5\x2f\xfd|\x1f\x8b")
"""The signatures of an uncompressed file, of Zstandard and of gzip."""
MODEL = FileKind("a model", rb"\x08[\x01-\x1f][\x12\x1a\x22\x3a]")
CHECKPOINT = FileKind("the checkpoint of a training", rb"PK\x03\x04.{26}about\.npy")
REPORT = FileKind("a training report", rb'\s*\{\s*"format":\s*"fdda-report"')
PAGE = FileKind("the page of a training report", rb"<!doctype html>.*training report</title>")
EVALUATION = FileKind("the JSON of an evaluation", _OBJECTS_PREFIX + rb'"unit":\s*"mm"')
BENCHMARK = FileKind("the JSON of a benchmark", _OBJECTS_PREFIX + rb'"unit":\s*"ms"')
WARNINGS = FileKind("the JSON of a check", rb'\s*\{\s*"warnings":')
RECORDING = FileKind("the index of a recording", rb'\s*\{\s*"format":\s*"fdda-recording"')
PICTURE = FileKind("a PNG picture", rb"\x89PNG\r\n")
VIDEO = FileKind("a video", rb".{4}ftyp|\x1a\x45\xdf\xa3")
"""The signatures of MPEG-4 and of Matroska, which WebM files use."""
ALEMBIC = FileKind("an Alembic file", rb"Ogawa|\x89HDF")
"""The signatures of Ogawa and of HDF5."""
USD = FileKind("a USD file", rb"PXR-USDC|#usda")
