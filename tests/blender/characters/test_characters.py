# SPDX-License-Identifier: GPL-3.0-or-later
"""Many kinds of characters: recorded, trained briefly, bound, and compared with their rigs and models.

`make characters` writes the results of the same rows into docs/characters.md.
"""

from pathlib import Path

import pytest

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
    "body_and_sleeve", "target_alembic",
}  # fmt: skip
"""Rows that `make test` trains, at least one of each topic; `make test-slow` trains the others.

`make test` trains characters with other transforms in test_transforms.py.
"""


def row_parameter(row: Row) -> object:
    return pytest.param(row, id=row.name, marks=() if row.name in QUICK_ROWS else pytest.mark.slow)


@pytest.mark.parametrize("row", [row_parameter(row) for row in ROWS])
def test_a_character_is_recorded_trained_and_played(row: Row, tmp_path: Path):
    for recording, model in record_row(row, tmp_path):
        train(recording, model, "--passes", row.epochs, *row.training, *SMALL)
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
