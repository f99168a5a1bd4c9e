# SPDX-License-Identifier: GPL-3.0-or-later
"""Files that another program has open: the add-on waits for them, and loses nothing if they stay open."""

import errno
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.errors import TRY_AGAIN, OutputError, exit_status
from fdda_addon.core.files import open_files
from fdda_addon.core.files.output import atomic_write_all, write_text
from fdda_addon.core.recording.folder import check_recordable, remove_recording
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from ..limb import make_rig, record_limb, recording_info

windows_only = pytest.mark.skipif(sys.platform != "win32", reason="Only on Windows, an open file cannot be replaced.")


@pytest.fixture
def refuse_renames(monkeypatch):
    """Let renames fail as on Windows; return a function that takes the number of failures for each file name."""
    remaining_failures: dict[str, int] = {}
    rename = os.replace

    def replace(source: Path, target: Path) -> None:
        if remaining_failures.get(os.path.basename(target), 0) > 0:
            remaining_failures[os.path.basename(target)] -= 1
            error = PermissionError(errno.EACCES, "Zugriff verweigert", str(source), None, str(target))
            error.winerror = 5
            raise error
        rename(source, target)

    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setattr(open_files, "RETRY_SECONDS", 0.3)
    monkeypatch.setattr(open_files, "MAX_PAUSE_SECONDS", 0.01)
    return remaining_failures.update


def file_texts(folder: Path) -> dict[str, str]:
    """Return the text of each file of the folder by its name."""
    return {path.name: path.read_text() for path in sorted(folder.iterdir())}


def test_a_file_that_is_open_briefly_is_replaced(tmp_path, refuse_renames, monkeypatch):
    monkeypatch.setattr(open_files, "RETRY_SECONDS", 30)
    write_text(tmp_path / "a", "old")
    refuse_renames({"a": 5})
    write_text(tmp_path / "a", "new")
    assert file_texts(tmp_path) == {"a": "new"}


@pytest.mark.parametrize("open_index", range(2))
def test_a_file_that_stays_open_is_not_replaced_and_new_files_are_kept(tmp_path, refuse_renames, open_index):
    paths = [tmp_path / name for name in ("a", "b", "c")]
    for path in paths[:2]:
        path.write_text("old")
    refuse_renames({paths[open_index].name: 10**9})
    with pytest.raises(OutputError) as error, atomic_write_all(*paths) as temporaries:
        for temporary in temporaries:
            temporary.write_text("new")
    names = "', '".join(path.name for path in temporaries)
    assert str(error.value) == (
        f"Cannot write '{paths[open_index]}': another program has it open; nothing was changed, and the new content is "
        f"in '{names}'; rename it when no program has '{paths[open_index].name}' open."
    )
    assert exit_status(error.value) == TRY_AGAIN
    assert file_texts(tmp_path) == {"a": "old", "b": "old"} | {path.name: "new" for path in temporaries}


@windows_only
def test_a_memory_mapped_recording_is_neither_removed_nor_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr(open_files, "RETRY_SECONDS", 0.2)
    record_limb(tmp_path / "r", 12)
    mapped_recording = read_recording(tmp_path / "r")
    with pytest.raises(OutputError, match=r"Cannot remove .*: another program has it open; end what uses it"):
        remove_recording(tmp_path / "r")
    check_recordable(tmp_path / "r", resume=False, overwrite=True)
    rig = make_rig()
    with pytest.raises(OutputError, match="another program has it open"):
        RecordingWriter(tmp_path / "r", rig, recording_info(12), overwrite=True)
    assert np.array_equal(mapped_recording.positions, read_recording(tmp_path / "r").positions)
    del mapped_recording
    remove_recording(tmp_path / "r")
    assert not (tmp_path / "r").exists()
