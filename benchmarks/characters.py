# SPDX-License-Identifier: GPL-3.0-or-later
"""How well models stand in for many kinds of characters: `python benchmarks/characters.py OUT [NAME …]`.

Builds the rows of `blend_fixtures.characters.rows`, records, trains, binds and compares each in the Blender whose
Python runs it, writes OUT/LINE.json, and puts the results of all lines in OUT into the table of docs/characters.md.
"""

import argparse
import json
import sys
import tempfile
from dataclasses import asdict
from datetime import date
from itertools import groupby
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import bpy  # noqa: E402

import fdda_addon  # noqa: E402
from blend_fixtures.characters.comparison import compare_row, record_row  # noqa: E402
from blend_fixtures.characters.rows import ROWS, Row  # noqa: E402
from blend_fixtures.characters.training import SMALL, Trainings  # noqa: E402

PAGE = ROOT / "docs" / "characters.md"
START, END = "<!-- make characters writes what follows -->", "<!-- until here -->"
LINES = ("4.5", "5.2")


def compare(rows: tuple[Row, ...], folder: Path) -> list[dict]:
    """Record, train, bind and compare rows; a result for each mesh."""
    with Trainings() as trainings:
        for row in rows:
            print(f"{row.name}: record", file=sys.stderr)
            (folder / row.name).mkdir()
            for recording, model in record_row(row, folder / row.name):
                trainings.add(recording, model, "--epochs", row.epochs, *SMALL)
        print("train", file=sys.stderr)
    found = []
    for row in rows:
        for result in compare_row(row, folder / row.name):
            found.append({"row": row.name, **asdict(result)})
            print(found[-1], file=sys.stderr)
    return found


def write_table(folder: Path) -> None:
    """Put what the lines in a folder have come to into the page."""
    files = [folder / f"{line}.json" for line in LINES]
    lines = {file.stem: json.loads(file.read_text(encoding="utf-8")) for file in files if file.exists()}
    text = PAGE.read_text(encoding="utf-8")
    before, after = text.partition(START)[0], text.partition(END)[2]
    PAGE.write_text(f"{before}{START}\n\n{table(lines)}\n\n{END}{after}", encoding="utf-8")


def table(lines: dict[str, dict]) -> str:
    """The results of some lines as Markdown, by topic."""
    header = "".join(f" {line}: linear skinning / FDDA, mm | part |" for line in lines)
    parts = ["; ".join(f"{own['date']}, Blender {own['blender']}" for own in lines.values()) + "."]
    for topic, rows in groupby(ROWS, lambda row: row.topic):
        parts += ["", f"### {topic}", "", f"| |{header} played, m |", "|---" * (2 * len(lines) + 2) + "|"]
        for row in rows:
            for mesh in row.meshes:
                own = [
                    next(r for r in line["results"] if (r["row"], r["mesh"]) == (row.name, mesh))
                    for line in lines.values()
                ]
                name = row.text + (f": `{mesh}`" if len(row.meshes) > 1 else "")
                cells = "".join(_cells(row, result) for result in own)
                parts.append(f"| {name} |{cells} {max(result['difference'] for result in own):.1g} |")
    return "\n".join(parts)


def _cells(row: Row, result: dict) -> str:
    linear, fdda = result["linear_mm"], result["fdda_mm"]
    part = "exact" if row.is_linear else f"{100 * fdda / linear:.1f} %"
    return f" {linear:.3f} / {fdda:.3f} | {part} |"


def main() -> None:
    """Compare the rows of the command line, or all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder for the results")
    parser.add_argument("names", nargs="*", help="rows to compare and print, with no table; all when there are none")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = tuple(row for row in ROWS if row.name in options.names) or ROWS
    fdda_addon.register()
    try:
        with tempfile.TemporaryDirectory() as folder:
            results = compare(rows, Path(folder))
    finally:
        fdda_addon.unregister()
    if rows is ROWS:
        line = ".".join(map(str, bpy.app.version[:2]))
        content = {"blender": bpy.app.version_string, "date": date.today().isoformat(), "results": results}
        (options.out / f"{line}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
        write_table(options.out)


if __name__ == "__main__":
    main()
