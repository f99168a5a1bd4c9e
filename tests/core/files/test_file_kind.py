# SPDX-License-Identifier: GPL-3.0-or-later
"""The kind of a file is recognized from its first bytes; files of another kind are not overwritten."""

import os

import pytest

from fdda_addon.core.errors import OutputError
from fdda_addon.core.files import file_kind
from fdda_addon.core.files.output import check_outputs, to_json_text

from ... import systems
from ..tiny_model import tiny_model

FILES_BY_KIND = {
    file_kind.BLEND: [b"BLENDER-v405", b"BLENDER17-01v0502", b"\x28\xb5\x2f\xfd\x00", b"\x1f\x8b\x08"],
    file_kind.MODEL: [tiny_model().SerializeToString()],
    file_kind.CHECKPOINT: [b"PK\x03\x04" + bytes(26) + b"about.npy" + bytes(9)],
    file_kind.REPORT: [to_json_text({"format": "fdda-report", "version": 1}).encode()],
    file_kind.PAGE: [b"<!doctype html>\n<html><head><title>m.onnx: training report</title>"],
    file_kind.EVALUATION: [
        to_json_text({"unit": "mm", "poses": 3}).encode(),
        to_json_text({"objects": {'a "quoted" name': {"unit": "mm"}}}).encode(),
    ],
    file_kind.BENCHMARK: [
        to_json_text({"unit": "ms"}).encode(),
        to_json_text({"objects": {"body": {"unit": "ms"}}}).encode(),
    ],
    file_kind.WARNINGS: [to_json_text({"warnings": []}).encode()],
    file_kind.PICTURE: [b"\x89PNG\r\n\x1a\n"],
    file_kind.ALEMBIC: [b"Ogawa\xff\0\x01", b"\x89HDF\r\n"],
    file_kind.USD: [b"PXR-USDC\0\x08", b"#usda 1.0\n"],
}
UNKNOWN_FILES = [
    b"a note\n",
    b'{"name": "package"}',
    to_json_text({"format": "fdda-recording", "version": 1}).encode(),
    b"<!doctype html><title>mine</title>",
    b"PK\x03\x04" + bytes(26) + b"photos/",
    b"\x93NUMPY\x01\x00",
    b"\0" * 100,
]


@pytest.mark.parametrize("kind", FILES_BY_KIND, ids=lambda kind: kind.name)
def test_a_kind_matches_only_its_own_files(tmp_path, kind):
    path = tmp_path / "file"
    for other_kind, file_starts in FILES_BY_KIND.items():
        for file_start in file_starts:
            path.write_bytes(file_start)
            assert kind.matches(path) == (other_kind is kind), (other_kind.name, file_start)
    for file_start in UNKNOWN_FILES:
        path.write_bytes(file_start)
        assert not kind.matches(path), file_start
    path.write_bytes(b"")
    assert kind.matches(path)


def test_files_of_the_kind_and_missing_files_may_be_written(tmp_path):
    existing_file = tmp_path / "old.json"
    existing_file.write_text(to_json_text({"unit": "mm"}))
    check_outputs(
        {existing_file: file_kind.EVALUATION, tmp_path / "new.png": file_kind.PICTURE}, [tmp_path / "rig.blend"]
    )


@systems.named_pipes
def test_unreadable_files_are_not_overwritten(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match="it is not a regular file"):
        check_outputs({tmp_path / "pipe": file_kind.MODEL}, overwrite=True)
