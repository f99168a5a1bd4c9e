# SPDX-License-Identifier: GPL-3.0-or-later
"""Files are told by how they begin, and nothing else is written over."""

import os

import pytest

from fdda_addon.core import file_kind
from fdda_addon.core.errors import OutputError
from fdda_addon.core.output import check_outputs, to_json_text

from .. import systems
from .tiny_model import tiny_model

SAMPLES = {
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
    file_kind.POINT_CACHE: [b"POINTCACHE2\0\x01\0\0\0"],
}
FOREIGN = [
    b"a note\n",
    b'{"name": "package"}',
    to_json_text({"format": "fdda-recording", "version": 1}).encode(),
    b"<!doctype html><title>mine</title>",
    b"PK\x03\x04" + bytes(26) + b"photos/",
    b"\x93NUMPY\x01\x00",
    b"\0" * 100,
]


@pytest.mark.parametrize("kind", SAMPLES, ids=lambda kind: kind.name)
def test_a_kind_knows_its_own_and_nothing_else(tmp_path, kind):
    path = tmp_path / "file"
    for other, samples in SAMPLES.items():
        for sample in samples:
            path.write_bytes(sample)
            assert kind.matches(path) == (other is kind), (other.name, sample)
    for sample in FOREIGN:
        path.write_bytes(sample)
        assert not kind.matches(path), sample
    path.write_bytes(b"")
    assert kind.matches(path)


def test_what_is_of_the_kind_or_not_there_is_written(tmp_path):
    old = tmp_path / "old.json"
    old.write_text(to_json_text({"unit": "mm"}))
    check_outputs({old: file_kind.EVALUATION, tmp_path / "new.png": file_kind.PICTURE}, [tmp_path / "rig.blend"])


@systems.named_pipes
def test_what_cannot_be_read_is_not_written_over(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match="it is not a regular file"):
        check_outputs({tmp_path / "pipe": file_kind.MODEL}, overwrite=True)
