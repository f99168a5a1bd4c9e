# SPDX-License-Identifier: GPL-3.0-or-later
"""The tables of docs/characters.md, and the characters that others made."""

import shutil
import subprocess
import sys

import pytest

from benchmarks import characters, third_party
from benchmarks.page_table import PageTable


def test_the_table_of_some_characters_does_not_replace_that_of_all(tmp_path):
    page = third_party.TABLE.page.read_bytes()
    arguments = [sys.executable, third_party.__file__, tmp_path, tmp_path, "--write", "--only", "Fox"]
    result = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert result.returncode == 2 and "not allowed with argument --write" in result.stderr
    assert third_party.TABLE.page.read_bytes() == page


@pytest.mark.parametrize("missing", ["start", "end"])
@pytest.mark.parametrize(("benchmark", "options"), [(third_party, ["folder", "--write"]), (characters, [])])
def test_a_page_without_the_place_of_the_table_is_refused(tmp_path, monkeypatch, benchmark, options, missing):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "elbow.blend").touch()
    page, table = tmp_path / "page.md", benchmark.TABLE
    page.write_text(table.page.read_text(encoding="utf-8").replace(getattr(table, missing), ""), encoding="utf-8")
    content = page.read_bytes()
    monkeypatch.setattr(benchmark, "TABLE", table._replace(page=page))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [benchmark.__file__, "out", *options])
    with pytest.raises(SystemExit) as ended:
        benchmark.main()
    # A text as the code is printed, and the status is 1.
    assert str(ended.value.code).startswith(f"'{page}' lacks the lines '{table.start}' and '{table.end}'")
    assert page.read_bytes() == content and not (tmp_path / "out").exists()


def test_a_table_takes_the_place_of_the_last_one(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("before\n<a>\nold\n<b>\nafter\n", encoding="utf-8")
    PageTable(page, "<a>", "<b>").write("new")
    assert page.read_text(encoding="utf-8") == "before\n<a>\n\nnew\n\n<b>\nafter\n"
    with pytest.raises(SystemExit):
        PageTable(page, "<b>", "<a>").write("newer")


@pytest.mark.parametrize(
    ("benchmark", "options", "message"),
    [
        (characters, ["out", "bbones", "b_bones"], "there is no row 'bbones'; the rows are "),
        (third_party, ["out", "folder", "--only", "elbow", "Fix"], "There is no character 'Fix' in 'folder'"),
    ],
)
def test_a_misspelled_name_is_refused(tmp_path, monkeypatch, capsys, benchmark, options, message):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "elbow.blend").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [benchmark.__file__, *options])
    with pytest.raises(SystemExit) as ended:
        benchmark.main()
    assert message in capsys.readouterr().err + str(ended.value.code) and not (tmp_path / "out").exists()


def test_the_folders_are_relative_to_the_working_directory(tmp_path):
    (tmp_path / "characters").mkdir()
    shutil.copy(third_party.ROOT / "blend_fixtures" / "elbow.blend", tmp_path / "characters")
    arguments = [third_party.__file__, "out", "characters", "--poses", "20", "--epochs", "1"]
    result = subprocess.run([sys.executable, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    row = result.stdout.splitlines()[-1]
    assert row.startswith("| elbow |  | 300 |") and "refused" not in row and "%" in row
    assert (tmp_path / "out" / "elbow" / "model.onnx").is_file()
