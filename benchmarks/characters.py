# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure how well models replace many kinds of rigs: `python benchmarks/characters.py OUT [NAME …]`.

Builds each row of `blend_fixtures.characters.rows`, then records, trains, binds and compares it in the Blender whose
Python runs this file. Writes OUT/VERSION.json, for example OUT/4.5.json. Then writes the results of all Blender
versions in OUT to the tables of docs/characters.md.
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
from benchmarks.page_table import PageTable  # noqa: E402
from blend_fixtures.characters.comparison import compare_row, record_row  # noqa: E402
from blend_fixtures.characters.rows import ROWS, Row  # noqa: E402
from blend_fixtures.characters.training import SMALL, Trainings  # noqa: E402

TABLE = PageTable(
    ROOT / "docs" / "characters.md", "<!-- make characters writes what follows -->", "<!-- until here -->"
)
BLENDER_VERSIONS = ("4.5", "5.2")


def compare(rows: tuple[Row, ...], folder: Path) -> list[dict]:
    """Record, train, bind and compare rows; return one result per mesh."""
    with Trainings() as trainings:
        for row in rows:
            print(f"{row.name}: record", file=sys.stderr)
            (folder / row.name).mkdir()
            for recording, model in record_row(row, folder / row.name):
                trainings.add(recording, model, "--passes", row.epochs, *row.training, *SMALL)
        print("train", file=sys.stderr)
    results = []
    for row in rows:
        for result in compare_row(row, folder / row.name):
            results.append({"row": row.name, **asdict(result)})
            print(results[-1], file=sys.stderr)
    return results


def write_tables(folder: Path) -> None:
    """Write the results of all Blender versions in a folder to the tables of the page."""
    files = [folder / f"{version}.json" for version in BLENDER_VERSIONS]
    runs = {file.stem: json.loads(file.read_text(encoding="utf-8")) for file in files if file.exists()}
    TABLE.write(format_tables(runs))


def format_tables(runs: dict[str, dict]) -> str:
    """Format the results of some Blender versions as one Markdown table per topic."""
    header = "".join(f" {version}: linear skinning / FDDA, mm | FDDA / linear |" for version in runs)
    lines = ["; ".join(f"{run['date']}, Blender {run['blender']}" for run in runs.values()) + "."]
    for topic, rows in groupby(ROWS, lambda row: row.topic):
        lines += ["", f"### {topic}", "", f"| |{header} played, m |", "|---" * (2 * len(runs) + 2) + "|"]
        for row in rows:
            for mesh in row.meshes:
                results = [
                    next(r for r in run["results"] if (r["row"], r["mesh"]) == (row.name, mesh))
                    for run in runs.values()
                ]
                name = row.text + (f": `{mesh}`" if len(row.meshes) > 1 else "")
                cells = "".join(_format_cells(row, result) for result in results)
                lines.append(f"| {name} |{cells} {max(result['difference'] for result in results):.1g} |")
    return "\n".join(lines)


def _format_cells(row: Row, result: dict) -> str:
    linear, fdda = result["linear_mm"], result["fdda_mm"]
    ratio = "exact" if row.is_linear else f"{100 * fdda / linear:.1f} %"
    return f" {linear:.3f} / {fdda:.3f} | {ratio} |"


def main() -> None:
    """Compare the rows that the command line names, or all rows."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder for the results")
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help="rows to compare and print without writing the table; by default all rows, with the table",
    )
    options = parser.parse_args()
    if unknown := sorted(set(options.names) - {row.name for row in ROWS}):
        parser.error(f"there is no row '{unknown[0]}'; the rows are {', '.join(row.name for row in ROWS)}")
    rows = tuple(row for row in ROWS if row.name in options.names or not options.names)
    writes_table = not options.names
    if writes_table:
        TABLE.check()
    options.out.mkdir(parents=True, exist_ok=True)
    fdda_addon.register()
    try:
        with tempfile.TemporaryDirectory() as folder:
            results = compare(rows, Path(folder))
    finally:
        fdda_addon.unregister()
    if writes_table:
        version = ".".join(map(str, bpy.app.version[:2]))
        content = {"blender": bpy.app.version_string, "date": date.today().isoformat(), "results": results}
        (options.out / f"{version}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
        write_tables(options.out)


if __name__ == "__main__":
    main()
