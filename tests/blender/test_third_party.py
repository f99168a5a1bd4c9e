# SPDX-License-Identifier: GPL-3.0-or-later
"""The table of characters that others made."""

import subprocess
import sys

from benchmarks import third_party


def test_the_table_of_some_characters_does_not_replace_that_of_all(tmp_path):
    page = third_party.PAGE.read_bytes()
    arguments = [sys.executable, third_party.__file__, tmp_path, tmp_path, "--write", "--only", "Fox"]
    result = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert result.returncode == 2 and "not allowed with argument --write" in result.stderr
    assert third_party.PAGE.read_bytes() == page
