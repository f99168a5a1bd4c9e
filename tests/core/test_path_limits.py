# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths that Windows or Blender would take for others, or not at all, are refused before the work."""

import os
import sys
from pathlib import Path, PureWindowsPath

import pytest

from fdda_addon.core import path_limits
from fdda_addon.core.errors import OutputError
from fdda_addon.core.file_kind import EVALUATION, PICTURE
from fdda_addon.core.output import check_folder_writable, check_outputs, check_writable
from fdda_addon.core.path_limits import windows_name_problem
from fdda_addon.core.recording.folder_check import check_recordable
from fdda_addon.core.recording.index import INDEX_NAME

DEVICE, DROPPED = "is the name of a device on Windows", "ends in a dot or a blank, which Windows drops"
PROBLEMS = {
    "con": f"'con' {DEVICE}",
    "nul.onnx": f"'nul.onnx' {DEVICE}",
    "AUX.tar.gz": f"'AUX.tar.gz' {DEVICE}",
    "com1": f"'com1' {DEVICE}",
    "LPT\u00b2 .x": f"'LPT\u00b2 .x' {DEVICE}",
    "prn/model.onnx": f"'prn' {DEVICE}",
    "model.": f"'model.' {DROPPED}",
    "model.onnx ": f"'model.onnx ' {DROPPED}",
    "why?.onnx": "'why?.onnx' has the character '?', which no name on Windows may have",
    "model.onnx:stream": "'model.onnx:stream' has the character ':', which no name on Windows may have",
}
GOOD = ("console.onnx", "com10", "null.onnx", ".con", "a.con", ".hidden", "a b.c", "\u00e9t\u00e9.onnx", "..", "comma")


@pytest.fixture
def windows(monkeypatch):
    """The checks of a Windows that takes no long paths."""
    monkeypatch.setattr(path_limits, "is_windows", lambda: True)
    monkeypatch.setattr(path_limits, "supports_long_windows_paths", lambda: False)


@pytest.mark.parametrize(("name", "words"), PROBLEMS.items())
def test_names_that_windows_takes_for_something_else(name, words):
    for anchor in ("C:\\", "\\\\server\\share\\", "\\\\?\\C:\\"):
        assert windows_name_problem(PureWindowsPath(anchor) / "folder" / name) == words


@pytest.mark.parametrize("name", GOOD)
def test_names_that_windows_takes(name):
    assert windows_name_problem(PureWindowsPath("C:\\") / name) == ""


@pytest.mark.usefixtures("windows")
def test_a_device_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(
        OutputError, match=r"Cannot write '.*nul\.onnx': 'nul\.onnx' is the name .*; give another name\."
    ):
        check_writable(tmp_path / "nul.onnx")
    with pytest.raises(OutputError, match=r"'aux' is the name of a device on Windows"):
        check_recordable(tmp_path / "aux" / "recording", resume=False)
    assert list(tmp_path.iterdir()) == []


def folder_of(length: int, tmp_path: Path) -> Path:
    """A folder, made on request, whose path has so many characters."""
    folder = tmp_path
    while len(str(folder)) < length - 1:
        folder = folder / ("d" * min(200, length - len(str(folder)) - 1))
    assert len(str(folder)) == length
    return folder


@pytest.mark.usefixtures("windows")
def test_the_longest_file_of_a_recording_has_to_fit(tmp_path):
    longest = len("/.fdda-0123456789ab.json")
    check_recordable(folder_of(259 - longest, tmp_path), resume=False)
    with pytest.raises(
        OutputError, match=r"it needs a path of 260 characters, and Windows takes 259; choose a shorter"
    ):
        check_recordable(folder_of(260 - longest, tmp_path), resume=False)
    check_folder_writable(folder_of(259, tmp_path))


@pytest.mark.usefixtures("windows")
def test_a_file_has_to_fit_with_the_name_that_it_has_while_it_is_written(tmp_path):
    folder = folder_of(234, tmp_path)
    folder.mkdir(parents=True)
    check_writable(folder / "a.json")
    with pytest.raises(OutputError, match="needs a path of 260 characters"):
        check_writable(folder / "a.jsons")


def test_long_paths_are_taken_where_windows_takes_them(tmp_path, monkeypatch):
    monkeypatch.setattr(path_limits, "is_windows", lambda: True)
    monkeypatch.setattr(path_limits, "supports_long_windows_paths", lambda: True)
    check_recordable(folder_of(300, tmp_path), resume=False)


@pytest.mark.skipif(sys.platform != "win32", reason="asks Windows")
def test_windows_says_whether_it_takes_long_paths():
    assert path_limits.supports_long_windows_paths() in (True, False)


def test_a_path_that_blender_would_cut_is_refused_on_every_system(tmp_path):
    """Blender counts bytes, and writes to what is left of the path."""
    folder = folder_of(1023 - len("/" + INDEX_NAME), tmp_path)
    with pytest.raises(OutputError, match=r"it needs a path of 1,032 bytes, and Blender takes 1,023; choose a shorter"):
        check_recordable(folder, resume=False)
    with pytest.raises(OutputError, match="bytes, and Blender takes 1,023"):
        check_writable(folder_of(1015, tmp_path) / "a.blend")


@pytest.mark.parametrize("system", ["win32", "darwin", "linux"])
def test_names_that_differ_by_letter_case_alone(tmp_path, monkeypatch, system):
    monkeypatch.setattr(path_limits.sys, "platform", system)
    outputs = [(tmp_path / "A.onnx", EVALUATION), (tmp_path / "a.onnx", PICTURE)]
    if system == "linux":
        check_outputs(outputs)
        return
    with pytest.raises(OutputError, match=r"a\.onnx': it would be the JSON .* and a PNG picture; give two names"):
        check_outputs(outputs)


def test_a_file_that_is_read_is_recognized_in_other_letters(tmp_path):
    (tmp_path / "rig.blend").write_bytes(b"BLENDER")
    if not os.path.exists(tmp_path / "RIG.blend"):
        pytest.skip("this disk tells small letters from capital ones")
    with pytest.raises(OutputError, match="it is read for this"):
        check_outputs({tmp_path / "RIG.blend": PICTURE}, [tmp_path / "rig.blend"])
