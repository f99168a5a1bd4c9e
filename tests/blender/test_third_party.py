# SPDX-License-Identifier: GPL-3.0-or-later
"""The table of characters that others made."""

import shutil
import subprocess
import sys

import pytest

from benchmarks import third_party


def test_the_table_of_some_characters_does_not_replace_that_of_all(tmp_path):
    page = third_party.PAGE.read_bytes()
    arguments = [sys.executable, third_party.__file__, tmp_path, tmp_path, "--write", "--only", "Fox"]
    result = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert result.returncode == 2 and "not allowed with argument --write" in result.stderr
    assert third_party.PAGE.read_bytes() == page


@pytest.mark.parametrize("missing", ["START", "END"])
def test_a_page_without_the_place_of_the_table_is_refused(tmp_path, monkeypatch, missing):
    (tmp_path / "elbow.blend").touch()
    page = tmp_path / "page.md"
    page.write_text(third_party.PAGE.read_text(encoding="utf-8").replace(getattr(third_party, missing), ""), "utf-8")
    content = page.read_bytes()
    monkeypatch.setattr(third_party, "PAGE", page)
    monkeypatch.setattr(sys, "argv", ["third_party.py", str(tmp_path), str(tmp_path), "--write"])
    with pytest.raises(SystemExit) as ended:
        third_party.main()
    # A text as the code is printed, and the status is 1.
    assert str(ended.value.code).startswith(
        f"'{page}' lacks the lines '<!-- third_party.py --write writes this table -->'"
    )
    assert page.read_bytes() == content


def test_the_folders_are_relative_to_the_working_directory(tmp_path):
    (tmp_path / "characters").mkdir()
    shutil.copy(third_party.ROOT / "blend_fixtures" / "elbow.blend", tmp_path / "characters")
    arguments = [third_party.__file__, "out", "characters", "--poses", "20", "--epochs", "1"]
    result = subprocess.run([sys.executable, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    row = result.stdout.splitlines()[-1]
    assert row.startswith("| elbow |  | 300 |") and "refused" not in row and "%" in row
    assert (tmp_path / "out" / "elbow" / "model.onnx").is_file()
