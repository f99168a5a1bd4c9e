# SPDX-License-Identifier: GPL-3.0-or-later
"""Defaults are defined once, in a module that Blender can import when it starts."""

import re
import subprocess
import sys
from pathlib import Path

from fdda_addon.core import defaults

ROOT = Path(__file__).parents[2]


def test_defaults_are_imported_without_numpy():
    code = "import sys, fdda_addon.core.defaults, fdda_addon.core.formats.report; print('numpy' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], cwd=ROOT, text=True).strip() == "False"


def test_no_setting_repeats_a_default():
    """A number as the `default=` of a setting could differ from the constant in defaults.py."""
    names = "poses|spread|min_partition_vertices|tolerance_mm|epochs|markers"
    literal_default = re.compile(
        rf"^\s*(?:{names}): \w+(?:Property\((?:[^()]|\([^()]*\))*?default)? ?= ?([1-9]|0\.0*[1-9])", re.MULTILINE
    )
    files = [*(ROOT / "fdda_addon").rglob("*.py"), *(ROOT / "trainer").rglob("*.py")]
    assert [
        (file.name, match[0]) for file in files for match in literal_default.finditer(file.read_text("utf-8"))
    ] == []


def test_every_default_is_used():
    texts = [file.read_text("utf-8") for file in [*(ROOT / "fdda_addon").rglob("*.py"), ROOT / "trainer" / "config.py"]]
    names = [name for name in vars(defaults) if name.isupper()]
    assert names and [n for n in names if sum(bool(re.search(rf"\b{n}\b", text)) for text in texts) < 3] == []
