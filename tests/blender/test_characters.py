# SPDX-License-Identifier: GPL-3.0-or-later
"""Many kinds of characters: recorded, trained briefly, bound, and compared with their rigs and their models.

docs/characters.md has the figures, which `make characters` writes; the same rows are held to their bars here.
"""

import ast
import re
from pathlib import Path

import pytest

from benchmarks.characters import END, START, table
from blend_fixtures.characters import controls, skinning, stacks, targets, transforms
from blend_fixtures.characters.comparison import compare_row, record_row
from blend_fixtures.characters.rows import ROWS, Row
from blend_fixtures.characters.training import SMALL

from .conftest import train

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "characters.md"
PLAYED = 1e-5
"""Meters: the evaluated mesh is the model's output within this."""
NOTHING_MM = 0.01
"""Errors below this are none."""
MOVED_MM = 10.0
"""The poses move the vertices by more, on average."""
QUICK = {
    "smooth_weights", "preserve_volume", "b_bones", "corrective_smooth", "geometry_nodes", "ik_fk", "custom_property",
    "body_and_sleeve", "parented_to_bone", "far_away", "in_millimetres", "target_alembic",
}  # fmt: skip
"""Rows that `make test` trains, at least one of each topic; `make test-slow` trains the others."""


def parameter(row: Row) -> object:
    return pytest.param(row, id=row.name, marks=() if row.name in QUICK else pytest.mark.slow)


@pytest.mark.parametrize("row", map(parameter, ROWS))
def test_a_character_is_learned_and_played(row: Row, tmp_path: Path):
    for recording, model in record_row(row, tmp_path):
        train(recording, model, "--epochs", row.epochs, *SMALL)
    results = compare_row(row, tmp_path)
    assert tuple(result.mesh for result in results) == row.meshes
    for result in results:
        assert result.moved_mm > MOVED_MM
        assert result.difference <= PLAYED
        if row.is_linear:
            assert max(result.linear_mm, result.fdda_mm) < NOTHING_MM
        else:
            assert result.linear_mm > NOTHING_MM
            assert result.fdda_mm < result.linear_mm


@pytest.mark.one_blender_version
def test_every_character_of_the_folder_has_a_row():
    built = {row.build for row in ROWS}
    assert built >= {*skinning.SKINNINGS, *stacks.STACKS, *controls.CONTROLS, *transforms.TRANSFORMS, *targets.TARGETS}
    assert {row.name for row in ROWS} > QUICK
    assert {row.topic for row in ROWS if row.name in QUICK} == {row.topic for row in ROWS}
    assert len({row.name for row in ROWS}) == len({row.text for row in ROWS}) == len(ROWS)


def results_of(page: str) -> dict[str, list[str]]:
    """The cells after the first of every row of the table that is made, by the first."""
    made = page.partition(START)[2].partition(END)[0]
    rows = [line.strip("| ").split(" | ") for line in made.splitlines() if line.startswith("| ")]
    return {cells[0]: cells[1:] for cells in rows}


@pytest.mark.one_blender_version
def test_the_page_has_every_row_and_each_meets_its_bars():
    found = results_of(PAGE.read_text(encoding="utf-8"))
    for row in ROWS:
        for mesh in row.meshes:
            *errors, played = found[row.text + (f": `{mesh}`" if len(row.meshes) > 1 else "")]
            assert len(errors) == 4 and float(played) <= PLAYED
            for pair in errors[::2]:
                linear, fdda = map(float, pair.split(" / "))
                assert max(linear, fdda) < NOTHING_MM if row.is_linear else fdda < linear


@pytest.mark.one_blender_version
def test_the_table_has_a_cell_for_every_line():
    result = {"linear_mm": 2.0, "fdda_mm": 0.5, "moved_mm": 100.0, "difference": 2e-8}
    results = [{"row": row.name, "mesh": mesh, **result} for row in ROWS for mesh in row.meshes]
    line = {"blender": "5.2.3", "date": "2026-01-01", "results": results}
    rows = results_of(f"{START}\n{table({'4.5': line, '5.2': line})}\n{END}")
    assert rows["Preserve Volume"] == ["2.000 / 0.500", "25.0 %", "2.000 / 0.500", "25.0 %", "2e-08"]


def sentences() -> set[str]:
    """Every text of the add-on, with … for what is filled in."""
    found = set()
    for file in (ROOT / "fdda_addon").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                found.add("".join(p.value if isinstance(p, ast.Constant) else "…" for p in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.add(node.value)
    return found


@pytest.mark.one_blender_version
def test_the_page_quotes_refusals_as_they_are():
    refusals = PAGE.read_text(encoding="utf-8").partition("## What is refused")[2]
    quoted = re.findall(r"\| \*(.+?)\* \|", refusals)
    texts = sentences()
    assert len(quoted) > 10
    assert [quote for quote in quoted if not any(quote in text for text in texts)] == []
