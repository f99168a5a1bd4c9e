# SPDX-License-Identifier: GPL-3.0-or-later
"""Files are replaced completely or not at all, and a path that cannot be written is refused before any work."""

import errno
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from fdda_addon.core.errors import OutputError
from fdda_addon.core.files import output
from fdda_addon.core.files.output import (
    atomic_write,
    atomic_write_all,
    check_folder_writable,
    check_writable,
    is_temporary_name,
    write_json,
    write_text,
)
from fdda_addon.core.recording.estimate import check_disk_space

from ... import systems

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


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_error_keeps_the_old_file(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(error), atomic_write(path) as temporary:
        temporary.write_text("half")
        raise error
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


def test_a_failed_rename_changes_no_file_and_keeps_the_new_files(tmp_path, monkeypatch):
    paths, replace_file = [tmp_path / "a", tmp_path / "b"], output.replace_file
    for path in paths:
        path.write_text("old")

    def refuse_second_file(source: Path, target: Path) -> None:
        if target == paths[1]:
            raise OSError(errno.EACCES, os.strerror(errno.EACCES))
        replace_file(source, target)

    monkeypatch.setattr(output, "replace_file", refuse_second_file)
    with pytest.raises(OutputError, match="nothing was changed"), atomic_write_all(*paths) as temporaries:
        for temporary in temporaries:
            temporary.write_text("new")
    assert [path.read_text() for path in (*paths, *temporaries)] == ["old", "old", "new", "new"]


def test_a_file_is_synced_before_it_is_renamed(tmp_path, monkeypatch):
    calls = []
    for name in ("fsync", "replace"):
        function = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, name=name, function=function: (calls.append(name), function(*a))[1])
    write_text(tmp_path / "a", "new")
    assert calls == ["fsync", "replace"]


def test_writing_below_what_is_no_folder_is_refused(tmp_path):
    (tmp_path / "file").touch()
    for name, reason in (("gone", systems.NOT_FOUND), ("file", systems.BELOW_A_FILE)):
        with pytest.raises(OutputError, match=rf"Cannot write '.*': {reason}; nothing was changed\."):
            write_text(tmp_path / name / "a.txt", "")


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


CHECK_PATHS_AS_NOBODY = """
import os, sys
from pathlib import Path
from fdda_addon.core.errors import OutputError
from fdda_addon.core.files.output import check_folder_writable, check_writable
os.setuid(65534)
for check, path in ((check_writable, sys.argv[1]), (check_folder_writable, sys.argv[1])):
    try:
        check(Path(path))
    except OutputError as error:
        print(error)
"""


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="Only root may become someone else.")
def test_a_folder_without_search_access_is_refused(tmp_path):
    """In Python 3.11, `Path.exists` raises an error for a path inside such a folder."""
    closed = tmp_path / "closed"
    (closed / "inside").mkdir(parents=True)
    closed.chmod(0)
    command = [sys.executable, "-c", CHECK_PATHS_AS_NOBODY, str(closed / "inside" / "a.json")]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    lines = result.stdout.splitlines()
    assert len(lines) == 2 and all(line.startswith("Cannot write") for line in lines), result.stderr
