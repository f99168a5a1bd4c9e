# SPDX-License-Identifier: GPL-3.0-or-later
"""Files are replaced completely or not at all, and a path that cannot be written is refused before any work."""

import errno
import json
import os
import re
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.errors import TRY_AGAIN, DiskFullError, OutputError, exit_status
from fdda_addon.core.files import file_kind, open_files, path_limits
from fdda_addon.core.files.file_kind import EVALUATION, PICTURE
from fdda_addon.core.files.output import (
    atomic_write,
    atomic_write_all,
    check_folder_writable,
    check_outputs,
    check_writable,
    is_temporary_name,
    to_json_text,
    write_json,
    write_text,
)
from fdda_addon.core.files.temporary import temporary_folder
from fdda_addon.core.recording.estimate import check_disk_space
from fdda_addon.core.recording.folder import check_recordable, remove_recording
from fdda_addon.core.recording.index import INDEX_NAME, read_index
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from ... import systems
from ..conftest import SMALL_DISK_BYTES
from ..limb import make_rig, random_poses, random_positions, record_limb, recording_info
from ..tiny_model import tiny_model

ROOT = Path(__file__).resolve().parents[3]


def file_names(folder: Path) -> list[str]:
    """Return the sorted names of the files in a folder."""
    return sorted(file.name for file in folder.iterdir())


def test_a_file_is_replaced(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "old")
    with atomic_write(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
        assert temporary.parent == tmp_path
    assert path.read_text() == "new"
    assert file_names(tmp_path) == ["a.txt"]


def test_an_error_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_write(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old" and file_names(tmp_path) == ["a.txt"]


def test_non_finite_json_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"é": [1.5, None]})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"mean": float("nan")})
    assert json.loads(path.read_text("utf-8")) == {"é": [1.5, None]}
    assert file_names(tmp_path) == ["a.json"]


@systems.symbolic_links
def test_temporary_names_are_random_and_links_are_not_followed(tmp_path, monkeypatch):
    path, victim = tmp_path / "a.json", tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / f".{os.getpid()}-a.json").symlink_to(victim)
    temporary_names = set()
    for _ in range(20):
        with atomic_write(path) as temporary:
            temporary_names.add(temporary.name)
            temporary.write_text("new")
    assert len(temporary_names) == 20 and all(is_temporary_name(name) for name in temporary_names)
    assert victim.read_text() == "precious" and path.read_text() == "new"
    # A link at a known temporary name is not followed either.
    monkeypatch.setattr("secrets.token_hex", lambda _: "0" * 12)
    (tmp_path / f".fdda-{'0' * 12}.json").symlink_to(victim)
    with pytest.raises(OutputError, match="File exists; nothing was changed"):
        write_text(path, "mine")
    assert victim.read_text() == "precious" and path.read_text() == "new"


def test_several_files_are_replaced_together(tmp_path):
    paths = [tmp_path / name for name in ("a", "b", "c")]
    for path in paths[:2]:
        path.write_text("old")
    with (
        pytest.raises(OutputError, match=r"'.*a' with 'b', 'c': No space left on device; nothing was changed"),
        atomic_write_all(*paths) as temporaries,
    ):
        for temporary in temporaries[:2]:
            temporary.write_text("new")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert [path.read_text() for path in paths[:2]] == ["old", "old"] and file_names(tmp_path) == ["a", "b"]
    with atomic_write_all(*paths) as temporaries:
        for temporary in temporaries:
            temporary.write_text("new")
    assert [path.read_text() for path in paths] == ["new"] * 3 and file_names(tmp_path) == ["a", "b", "c"]


def test_a_file_is_synced_before_it_is_renamed(tmp_path, monkeypatch):
    calls = []
    for name in ("fsync", "replace"):
        function = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, name=name, function=function: (calls.append(name), function(*a))[1])
    write_text(tmp_path / "a", "new")
    assert calls == ["fsync", "replace"]


def test_a_name_that_is_too_long_is_refused(tmp_path):
    check_folder_writable(tmp_path / ("a" * 100))
    words = "File name too long; choose a folder that you may write, or another name"
    if systems.WINDOWS:
        words = "Windows takes 259; choose a shorter folder|another name"
    for check in (check_writable, check_folder_writable):
        for name in ("a" * 298 + "é", "人" * 84 + "a.onnx"):
            if not systems.WINDOWS or len(name) > 259:
                with pytest.raises(OutputError, match=words):
                    check(tmp_path / name)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        (".", "it is a folder; give the name of a file"),
        (os.devnull, f"{os.devnull}': it is not a regular file"),
        ("none/a.txt", r"the folder '.*none' does not exist; create it first"),
        ("file/below/deep", r"the folder .* does not exist"),
    ],
)
def test_a_path_that_cannot_be_a_file_is_refused(tmp_path, path, words):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=words):
        check_writable(tmp_path / path)


@systems.drives
def test_a_missing_drive_is_refused():
    path = Path(systems.UNWRITABLE) / "a"
    words = re.escape(f"Cannot write into '{path}': '{path.anchor}' does not exist; choose another folder.")
    with pytest.raises(OutputError, match=words):
        check_folder_writable(path)
    with pytest.raises(OutputError, match=words):
        check_disk_space(path, 1000)


@pytest.mark.skipif(sys.platform != "linux", reason="Only Linux has /proc.")
def test_a_folder_without_write_access_is_refused():
    """Permissions do not restrict root, but nobody can create files in /proc."""
    for check, path in ((check_writable, Path("/proc/a.json")), (check_folder_writable, Path("/proc/a/b"))):
        with pytest.raises(OutputError, match=f"Cannot write '{path}': .*; choose a folder that you may write"):
            check(path)


@pytest.fixture
def windows_without_long_paths(monkeypatch):
    """Let the checks run as on a Windows that does not support long paths."""
    monkeypatch.setattr(path_limits, "is_windows", lambda: True)
    monkeypatch.setattr(path_limits, "supports_long_windows_paths", lambda: False)


@pytest.mark.usefixtures("windows_without_long_paths")
@pytest.mark.parametrize("name", ["model.", "model.onnx ", "model.onnx:stream", "a. /model.onnx"])
def test_a_name_that_windows_changes_is_refused(tmp_path, name):
    with pytest.raises(OutputError, match="has a colon, or a dot or a blank at its end, which Windows changes"):
        check_writable(tmp_path / name)
    check_writable(tmp_path / ".." / tmp_path.name / ".a b.c")


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


@systems.named_pipes
def test_unreadable_files_are_not_overwritten(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match="it is not a regular file"):
        check_outputs({tmp_path / "pipe": file_kind.MODEL}, overwrite=True)


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


FULL_DISK_ERROR = "No space left on device"


@pytest.mark.parametrize("kind", ["write", "output", "blender"])
def test_a_full_temporary_disk_is_the_machines_fault(small_disk, monkeypatch, kind):
    monkeypatch.setattr(tempfile, "tempdir", str(small_disk))
    with (
        pytest.raises(DiskFullError, match=rf"^No temporary file can be written \(.*{FULL_DISK_ERROR}.*\); make room"),
        temporary_folder() as folder,
    ):
        if kind == "write":
            (folder / "a").write_bytes(bytes(2 * SMALL_DISK_BYTES))
        if kind == "output":
            write_text(folder / "a", "x" * 2 * SMALL_DISK_BYTES)
        raise OutputError(f"Cannot write '{folder / 'a'}': {FULL_DISK_ERROR}")  # as of Blender, without an errno
    assert list(small_disk.iterdir()) == []


def test_an_error_of_another_folder_is_no_error_of_the_temporary_folder():
    for error in (OutputError("Cannot write '/other/a'"), FileNotFoundError(2, "missing", "/other/a")):
        with pytest.raises(type(error)) as raised, temporary_folder() as folder:
            raise error
        assert raised.value is error and not folder.exists()


@pytest.fixture
def _no_space_reservation(monkeypatch):
    """Remove the function that reserves space for a file, which some systems lack."""
    monkeypatch.delattr(os, "posix_fallocate", raising=False)


@pytest.mark.usefixtures("_no_space_reservation")
def test_a_disk_that_fills_up_during_a_recording_leaves_complete_poses(small_disk, tmp_path):
    path, rig, poses = small_disk / "recording", make_rig(), 100
    matrices, residuals = random_poses(poses), random_positions(poses)
    ballast = small_disk / "ballast"
    with (
        pytest.raises(
            OutputError, match=rf"Cannot write the recording .*: {FULL_DISK_ERROR}; 20 of 100 poses are complete; make"
        ),
        RecordingWriter(path, rig, recording_info(poses)) as writer,
    ):
        writer.append(matrices[:20], residuals[:20])
        ballast.write_bytes(b"x" * (os.statvfs(small_disk).f_bavail - 4) * 4096)
        writer.append(matrices[20:90], residuals[20:90])
    assert read_index(path)["complete"] == 20
    ballast.unlink()
    # There is space again, but not for the whole recording, so a copy on another disk is resumed.
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for file in path.iterdir():
        (elsewhere / file.name).write_bytes(file.read_bytes())
    record_limb(elsewhere, poses, resume=True)
    assert (read_recording(elsewhere).positions == residuals).all()
