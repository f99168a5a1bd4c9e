# SPDX-License-Identifier: GPL-3.0-or-later
"""Many kinds of characters: recorded, trained briefly, bound, and compared with their rigs and models.

`make characters` writes the results of the same rows into docs/characters.md.
"""

import ast
import re
from pathlib import Path

import pytest

from benchmarks.characters import TABLE, format_tables
from blend_fixtures.characters import controls, skinning, stacks, targets, transforms
from blend_fixtures.characters.comparison import compare_row, record_row
from blend_fixtures.characters.rows import ROWS, Row
from blend_fixtures.characters.training import SMALL

from ..conftest import train

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "characters.md"
MAX_PLAYBACK_DIFFERENCE = 1e-5
"""Largest distance between the evaluated mesh and the model's output, in meters."""
NEGLIGIBLE_ERROR_MM = 0.01
"""Smaller errors count as zero."""
MIN_MOVEMENT_MM = 10.0
"""Smallest mean distance by which the poses must move the vertices."""
QUICK_ROWS = {
    "smooth_weights", "preserve_volume", "b_bones", "corrective_smooth", "geometry_nodes", "ik_fk", "custom_property",
    "body_and_sleeve", "parented_to_bone", "far_away", "in_millimetres", "target_alembic",
}  # fmt: skip
"""Rows that `make test` trains, at least one of each topic; `make test-slow` trains the others."""


def row_parameter(row: Row) -> object:
    return pytest.param(row, id=row.name, marks=() if row.name in QUICK_ROWS else pytest.mark.slow)


@pytest.mark.parametrize("row", [row_parameter(row) for row in ROWS])
def test_a_character_is_recorded_trained_and_played(row: Row, tmp_path: Path):
    for recording, model in record_row(row, tmp_path):
        train(recording, model, "--epochs", row.epochs, *row.training, *SMALL)
    results = compare_row(row, tmp_path)
    assert tuple(result.mesh for result in results) == row.meshes
    for result in results:
        assert result.moved_mm > MIN_MOVEMENT_MM
        assert result.difference <= MAX_PLAYBACK_DIFFERENCE
        if row.is_linear:
            assert max(result.linear_mm, result.fdda_mm) < NEGLIGIBLE_ERROR_MM
        else:
            assert result.linear_mm > NEGLIGIBLE_ERROR_MM
            assert result.fdda_mm < result.linear_mm


@pytest.mark.one_blender_version
def test_every_built_character_has_a_row():
    build_functions = {row.build for row in ROWS}
    assert build_functions >= {
        *skinning.SKINNINGS,
        *stacks.STACKS,
        *controls.CONTROLS,
        *transforms.TRANSFORMS,
        *targets.TARGETS,
    }
    assert {row.name for row in ROWS} > QUICK_ROWS
    assert {row.topic for row in ROWS if row.name in QUICK_ROWS} == {row.topic for row in ROWS}
    assert len({row.name for row in ROWS}) == len({row.text for row in ROWS}) == len(ROWS)


def results_by_row(page: str) -> dict[str, list[str]]:
    """Return the other cells of each row of the generated table, by the first cell of the row."""
    table_text = page.partition(TABLE.start)[2].partition(TABLE.end)[0]
    rows = [line.strip("| ").split(" | ") for line in table_text.splitlines() if line.startswith("| ")]
    return {cells[0]: cells[1:] for cells in rows}


@pytest.mark.one_blender_version
def test_the_page_contains_every_row_with_small_errors():
    results = results_by_row(PAGE.read_text(encoding="utf-8"))
    for row in ROWS:
        for mesh in row.meshes:
            *errors, difference = results[row.text + (f": `{mesh}`" if len(row.meshes) > 1 else "")]
            assert len(errors) == 4 and float(difference) <= MAX_PLAYBACK_DIFFERENCE
            for pair in errors[::2]:
                linear, fdda = map(float, pair.split(" / "))
                assert max(linear, fdda) < NEGLIGIBLE_ERROR_MM if row.is_linear else fdda < linear


@pytest.mark.one_blender_version
def test_the_table_has_cells_for_every_blender_version():
    result = {"linear_mm": 2.0, "fdda_mm": 0.5, "moved_mm": 100.0, "difference": 2e-8}
    results = [{"row": row.name, "mesh": mesh, **result} for row in ROWS for mesh in row.meshes]
    line = {"blender": "5.2.3", "date": "2026-01-01", "results": results}
    rows = results_by_row(f"{TABLE.start}\n{format_tables({'4.5': line, '5.2': line})}\n{TABLE.end}")
    assert rows["Preserve Volume"] == ["2.000 / 0.500", "25.0 %", "2.000 / 0.500", "25.0 %", "2e-08"]


def texts_of_the_add_on() -> set[str]:
    """Return every string in the code of the add-on, with … in place of inserted values."""
    texts = set()
    for file in (ROOT / "fdda_addon").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                texts.add("".join(p.value if isinstance(p, ast.Constant) else "…" for p in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.add(node.value)
    return texts


@pytest.mark.one_blender_version
def test_the_page_quotes_error_messages_literally():
    refusals = PAGE.read_text(encoding="utf-8").partition("## What is refused")[2]
    quoted = re.findall(r"\| \*(.+?)\* \|", refusals)
    texts = texts_of_the_add_on()
    assert len(quoted) > 10
    assert [quote for quote in quoted if not any(quote in text for text in texts)] == []
