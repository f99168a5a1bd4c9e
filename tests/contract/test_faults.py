# SPDX-License-Identifier: GPL-3.0-or-later
"""The seeded faults match the code: the text of each fault occurs once in its file, and its tests exist."""

import ast
import os
import sys
import time

import pytest

from benchmarks.faults import ROOT, Fault, copy_checkout, read_faults, run_command

FAULTS = read_faults()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.id)
def test_the_text_of_a_fault_occurs_once(fault: Fault):
    text = (ROOT / fault.file).read_text(encoding="utf-8")
    assert text.count(fault.old) == 1, fault.file
    # The changed code must be valid and different; any test would catch a syntax error.
    assert ast.dump(ast.parse(fault.applied(text))) != ast.dump(ast.parse(text))


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.id)
def test_the_tests_that_catch_a_fault_exist(fault: Fault):
    assert fault.tests
    assert [test for test in fault.tests if not (ROOT / test).is_file()] == []


def test_ids_of_faults_are_unique():
    assert len({fault.id for fault in FAULTS}) == len(FAULTS)


@pytest.mark.skipif(sys.platform == "win32", reason="make faults needs a POSIX system")
def test_the_timeout_kills_the_child_processes_of_a_test_run(tmp_path):
    script = (
        "import pathlib, subprocess, sys; child = subprocess.Popen(['sleep', '60']);"
        "pathlib.Path('pid').write_text(str(child.pid)); child.wait()"
    )
    assert run_command([sys.executable, "-c", script], tmp_path, dict(os.environ), 2)[0] is None
    process = int((tmp_path / "pid").read_text())
    deadline = time.monotonic() + 20
    while _is_running(process):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    # A killed process without a parent that waits for it stays as a zombie.
    return "(zombie)" not in open(f"/proc/{process}/status").read() if os.path.isdir("/proc") else True


@pytest.mark.skipif(sys.platform == "win32", reason="make faults needs a POSIX system")
def test_the_copy_of_the_checkout_leaves_out_a_deleted_file(tmp_path, monkeypatch):
    (tmp_path / "checkout" / ".venv").mkdir(parents=True)
    (tmp_path / "checkout" / "kept.py").write_text("pass")
    monkeypatch.setattr("benchmarks.faults.ROOT", tmp_path / "checkout")
    monkeypatch.setattr("subprocess.run", lambda *_, **__: type("Result", (), {"stdout": b"kept.py\0deleted.py\0"}))
    copy_checkout(tmp_path / "copy")
    assert sorted(path.name for path in (tmp_path / "copy").iterdir()) == [".venv", "kept.py", "out"]
