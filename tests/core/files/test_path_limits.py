# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths that are too long for Windows or Blender are refused before any work."""

from pathlib import Path

import pytest

from fdda_addon.core.errors import OutputError
from fdda_addon.core.files import path_limits
from fdda_addon.core.files.file_kind import EVALUATION, PICTURE
from fdda_addon.core.files.output import check_folder_writable, check_outputs, check_writable
from fdda_addon.core.recording.folder import check_recordable
from fdda_addon.core.recording.index import INDEX_NAME


@pytest.fixture
def windows_without_long_paths(monkeypatch):
    """Let the checks run as on a Windows that does not support long paths."""
    monkeypatch.setattr(path_limits, "is_windows", lambda: True)
    monkeypatch.setattr(path_limits, "supports_long_windows_paths", lambda: False)


def folder_with_length(length: int, tmp_path: Path) -> Path:
    """Return the path of a folder, which may not exist, with this number of characters."""
    folder = tmp_path
    while len(str(folder)) < length - 1:
        folder = folder / ("d" * min(200, length - len(str(folder)) - 1))
    assert len(str(folder)) == length
    return folder


@pytest.mark.usefixtures("windows_without_long_paths")
def test_a_recording_whose_longest_path_exceeds_the_limit_is_refused(tmp_path):
    temporary_name_length = len("/.fdda-0123456789ab.json")
    check_recordable(folder_with_length(259 - temporary_name_length, tmp_path), resume=False)
    with pytest.raises(
        OutputError, match=r"it needs a path of 260 characters, and Windows takes 259; choose a shorter"
    ):
        check_recordable(folder_with_length(260 - temporary_name_length, tmp_path), resume=False)
    check_folder_writable(folder_with_length(259, tmp_path))


@pytest.mark.usefixtures("windows_without_long_paths")
def test_a_file_whose_temporary_path_exceeds_the_limit_is_refused(tmp_path):
    folder = folder_with_length(234, tmp_path)
    folder.mkdir(parents=True)
    check_writable(folder / "a.json")
    with pytest.raises(OutputError, match="needs a path of 260 characters"):
        check_writable(folder / "a.jsons")


def test_a_path_that_blender_would_truncate_is_refused_on_every_system(tmp_path):
    """Blender truncates a path that has too many bytes and writes to another file."""
    folder = folder_with_length(1023 - len("/" + INDEX_NAME), tmp_path)
    with pytest.raises(OutputError, match=r"it needs a path of 1,032 bytes, and Blender takes 1,023; choose a shorter"):
        check_recordable(folder, resume=False)
    with pytest.raises(OutputError, match="bytes, and Blender takes 1,023"):
        check_writable(folder_with_length(1015, tmp_path) / "a.blend")


@pytest.mark.parametrize("system", ["win32", "darwin", "linux"])
def test_names_that_differ_only_in_case(tmp_path, monkeypatch, system):
    monkeypatch.setattr(path_limits.sys, "platform", system)
    outputs = [(tmp_path / "A.onnx", EVALUATION), (tmp_path / "a.onnx", PICTURE)]
    if system == "linux":
        check_outputs(outputs)
        return
    with pytest.raises(OutputError, match=r"a\.onnx': it would be the JSON .* and a PNG picture; give two names"):
        check_outputs(outputs)
