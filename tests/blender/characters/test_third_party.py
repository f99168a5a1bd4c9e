# SPDX-License-Identifier: GPL-3.0-or-later
"""The benchmarks of characters: misspelled names, and folders."""

import shutil
import subprocess
import sys

import pytest

from benchmarks import characters, third_party


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
