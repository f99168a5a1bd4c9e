# SPDX-License-Identifier: GPL-3.0-or-later
"""Exit statuses of errors, libraries that cannot be loaded, and processes that end."""

import errno
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fdda_addon.core.errors import (
    TRY_AGAIN,
    BusyError,
    DiskFullError,
    OutputError,
    RigError,
    TrainingDiedError,
    WrongUsageError,
    exit_status,
    os_error_text,
)
from fdda_addon.core.files import native_library
from fdda_addon.core.files.child_process import OutputLines, child_options, end_process
from fdda_addon.core.files.native_library import check_cpp_library, loaded_cpp_library_version, runtime_advice

from ...systems import WINDOWS


def error_caused_by(cause: BaseException) -> OutputError:
    """Return an error of the add-on whose `__cause__` is the given exception."""
    try:
        raise OutputError("It failed.") from cause
    except OutputError as error:
        return error


@pytest.mark.parametrize("error_code", [errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ENOMEM, errno.ESTALE])
def test_failures_of_the_machine_may_be_tried_again(error_code):
    assert exit_status(error_caused_by(OSError(error_code, "text"))) == TRY_AGAIN
    assert exit_status(error_caused_by(error_caused_by(OSError(error_code, "text")))) == TRY_AGAIN


@pytest.mark.parametrize("error_code", [32, 33, 39, 112, 1224, 1455])
def test_windows_failures_of_the_machine_may_be_tried_again(error_code):
    error = OSError(errno.EINVAL, "in the language of the system")
    error.winerror = error_code
    assert exit_status(error_caused_by(error)) == TRY_AGAIN
    assert os_error_text(error) != error.strerror and os_error_text(error).isascii()


def test_localized_windows_messages_are_not_quoted():
    error = PermissionError(errno.EACCES, "Zugriff verweigert")
    error.winerror = 5
    assert os_error_text(error) == "Permission denied" and exit_status(error_caused_by(error)) == 1
    assert os_error_text(OSError(errno.EINVAL, "it is not a regular file")) == "it is not a regular file"


@pytest.mark.parametrize("error_code", [errno.ENOENT, errno.EACCES, errno.EISDIR, errno.EROFS, errno.ENAMETOOLONG])
def test_failures_of_the_user_are_not_tried_again(error_code):
    assert exit_status(error_caused_by(OSError(error_code, "text"))) == 1


def test_exit_status_of_error_classes():
    assert [exit_status(kind("text")) for kind in (BusyError, DiskFullError, TrainingDiedError)] == [TRY_AGAIN] * 3
    assert exit_status(RigError("text")) == 1 and exit_status(WrongUsageError("text")) == 2
    assert exit_status(error_caused_by(MemoryError())) == TRY_AGAIN


RUNTIME = "install Microsoft's Visual C++ runtime from https://aka.ms/vs/17/release/vc_redist."

PYBIND = "DLL load failed while importing onnxruntime_pybind11_state: "

TORCH = '. Error loading "C:\\torch\\lib\\c10.dll" or one of its dependencies.'

AGAIN = ("install the training environment again", "install the extension's zip")


@pytest.mark.parametrize(
    ("text", "for_trainer", "for_blender"),
    [
        (f"[WinError 126] Das angegebene Modul wurde nicht gefunden{TORCH}", RUNTIME, "virus scanner removed"),
        (f"{PYBIND}Le module spécifié est introuvable.", RUNTIME, "virus scanner removed"),
        ("'x.pyd' needs msvcp140.dll 14.40 or later, and Blender has loaded 14.29", RUNTIME, "use a newer Blender"),
        (f"[WinError 1455] Die Auslagerungsdatei ist zu klein{TORCH}", "enlarge the paging", "enlarge the paging file"),
        ("/x/a.so: failed to map segment from shared object: Cannot allocate memory", "end other", "end other"),
        ("libstdc++.so.6: version `GLIBCXX_3.4.32' not found", "GLIBCXX_3.4.32 is needed", "names an older library"),
        ("/x/a.so: invalid ELF header", *AGAIN),
        ("libgomp.so.1: cannot open shared object file: No such file", "has 'libgomp.so.1'", "has 'libgomp.so.1'"),
        ("/x/a.so: cannot open shared object file: No such file", *AGAIN),
        ("dlopen(a.so, 0x2): Library not loaded: @rpath/libomp.dylib", *AGAIN),
        ("No module named 'torch'", "", ""),
        ("f() got an unexpected keyword argument 'self'", "", ""),
        ("[WinError 112] There is not enough space on the disk: 'x.npy'", "", ""),
    ],
)
def test_each_cause_has_its_advice(text: str, for_trainer: str, for_blender: str):
    for advice, expected in ((runtime_advice(text), for_trainer), (runtime_advice(text, in_blender=True), for_blender)):
        assert expected in advice and bool(advice) == bool(expected)
        assert not advice.endswith(".") and "{" not in advice and ("vc_redist" in advice) == (expected == RUNTIME)


PRINT_STATE = "import json, sys; print(json.dumps([sys.flags.optimize, sys.path, 'Jürgen']))"


def test_a_child_ignores_what_a_launcher_sets_for_another_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "launcher").mkdir()
    (tmp_path / "launcher" / "json.py").write_text("raise ImportError('of another Python')")
    variables = {"PYTHONHOME": "/nowhere", "PYTHONPATH": str(tmp_path / "launcher"), "PYTHONOPTIMIZE": "2"}
    variables |= {"PYTHONMALLOC": "no name", "PYTHONHASHSEED": "no number", "PYTHONPLATLIBDIR": "foo"}
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    command = [sys.executable, "-c", PRINT_STATE]
    result = subprocess.run(command, capture_output=True, check=False, **child_options(tmp_path / "own"))
    assert result.returncode == 0, result.stderr
    optimization, paths, text = json.loads(result.stdout)
    assert optimization == sys.flags.optimize and text == "Jürgen"
    assert str(tmp_path / "own") in paths and str(tmp_path / "launcher") not in paths


def test_a_child_imports_from_the_folders_of_pythonpath_that_this_python_uses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path / "used")])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "other"), f"{tmp_path / 'used'}{os.sep}"]))
    monkeypatch.setenv("PYTHONNOUSERSITE", "1")
    environment = child_options(tmp_path)["env"]
    assert environment["PYTHONPATH"] == os.pathsep.join([str(tmp_path), f"{tmp_path / 'used'}{os.sep}"])
    assert environment["PYTHONNOUSERSITE"] == "1"


def test_lines_are_read_while_the_child_runs_and_it_is_killed():
    code = "import time; print('first', flush=True); time.sleep(60)"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, **child_options())
    lines = OutputLines(process.stdout)
    assert lines.next(30) == "first\n" and lines.next() == "" and not lines.join(0.01)
    end_process(process, 0.01)
    assert process.returncode and lines.join(30) and lines.next() is None
    process.stdout.close()


@pytest.mark.parametrize(
    ("loaded", "version", "is_refused"),
    [
        ((14, 29), "1.21.0", True),
        ((14, 29), "1.20.1", False),
        ((14, 40), "1.31.1", False),
        (None, "1.31.1", False),
    ],
)
def test_a_runtime_that_would_end_the_process_is_not_imported(monkeypatch, loaded, version, is_refused):
    monkeypatch.setattr(native_library, "loaded_cpp_library_version", lambda: loaded)
    monkeypatch.setattr(native_library.metadata, "version", lambda _: version)
    if not is_refused:
        check_cpp_library()
        return
    with pytest.raises(ImportError, match=r"1\.21\.0 needs msvcp140\.dll 14\.40, and Blender has loaded 14\.29"):
        check_cpp_library()


@pytest.mark.skipif(not WINDOWS, reason="Only Windows has this library.")
@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="bpy is not installed.")
def test_the_version_of_the_loaded_library_is_read():
    import bpy  # noqa: F401 - loads Blender's library

    assert loaded_cpp_library_version() == ((14, 29) if sys.version_info < (3, 13) else (14, 44))
