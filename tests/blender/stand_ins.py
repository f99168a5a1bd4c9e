# SPDX-License-Identifier: GPL-3.0-or-later
"""Fake programs that run in place of Python or the trainer, on every operating system."""

import os
import sys
from pathlib import Path

import pytest

from fdda_addon.core.formats.messages import Message, MessageType
from fdda_addon.training.environment.choice import PYTHON_VARIABLE

_SITE_CUSTOMIZE = """
import sys
if "trainer" in sys.orig_argv:
    import os, signal, time
    try:
{code}
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
"""


def import_from(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this Python and its child processes import from a folder, as if this Python was started with PYTHONPATH."""
    monkeypatch.setattr(sys, "path", [*sys.path, str(folder)])
    monkeypatch.setenv("PYTHONPATH", str(folder))
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")


def stand_in_trainer(folder: Path, monkeypatch: pytest.MonkeyPatch, *lines: str, status: int = 0) -> None:
    """Run lines of Python code instead of the trainer, and exit with a status."""
    packages = folder / "packages"
    packages.mkdir()
    code = "\n".join(f"        {line}" for line in (f"status = {status}", *lines))
    (packages / "sitecustomize.py").write_text(_SITE_CUSTOMIZE.format(code=code), encoding="utf-8")
    import_from(packages, monkeypatch)
    monkeypatch.setenv(PYTHON_VARIABLE, sys.executable)


def print_message_code(kind: MessageType, **values) -> str:
    """Return a line of code that prints a message of the trainer."""
    return f"print({Message(kind, values).encode()!r}, flush=True)"


def write_program(path: Path, *lines: str) -> str:
    """Write a program that runs lines of Python code, whatever its arguments; return its path."""
    script = path.with_name(f"{path.name}.py")
    script.write_text("\n".join(["import json, os, subprocess, sys, time", *lines, ""]), encoding="utf-8")
    if os.name == "nt":
        path = path.with_name(f"{path.name}.cmd")
        path.write_text(f'@"{sys.executable}" "{script}" %*\n', encoding="utf-8")
    else:
        path.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{script}" "$@"\n', encoding="utf-8")
        path.chmod(0o755)
    return str(path)
