# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes the page of a report again: `python -m trainer.report REPORT.json`. It does not need torch."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from fdda_addon.core.errors import FDDAError
from fdda_addon.core.file_kind import PAGE
from fdda_addon.core.output import check_outputs, write_text
from fdda_addon.core.report import page_path, read_report
from fdda_addon.core.terminal import escape_unencodable_output

from .page import render_html
from .validation import check_drawable, read_evaluation


def write_html(report: dict, path: Path, pictures: Sequence[Path] = (), evaluation: dict | None = None) -> None:
    """Write the page of a report, optionally with pictures and an evaluation.

    Args:
        report: content of `report.json`.
        path: path of the page.
        pictures: PNG or JPEG files to show.
        evaluation: content of the JSON that `evaluate` wrote; None without one.

    Raises:
        OutputError: the page cannot be written.
    """
    write_text(path, render_html(report, pictures, evaluation))


def main(arguments: list[str] | None = None) -> int:
    """Run `python -m trainer.report REPORT.json`, which writes the page again; returns the exit status."""
    escape_unencodable_output()
    parser = argparse.ArgumentParser("trainer.report", description="Write the page of a training report again.")
    parser.add_argument("report", type=Path, help="report.json; the page is written beside it")
    parser.add_argument("--pictures", type=Path, help="folder of PNG or JPEG files to show, in order of their names")
    parser.add_argument("--evaluation", type=Path, help="JSON that evaluate wrote")
    parser.add_argument("--overwrite", action="store_true", help="overwrite a page that is no report")
    options = parser.parse_args(arguments)
    try:
        page = page_path(options.report)
        check_outputs({page: PAGE}, [options.report], options.overwrite)
        report = read_report(options.report)
        check_drawable(report, options.report)
        pictures = []
        if options.pictures:
            pictures = sorted(p for p in options.pictures.glob("*") if p.suffix.lower() in (".png", ".jpg", ".jpeg"))
        evaluation = read_evaluation(options.evaluation) if options.evaluation else None
        write_html(report, page, pictures, evaluation)
    except FDDAError as error:
        print(error, file=sys.stderr)
        return 1
    except OSError as error:
        print(f"A picture cannot be read: {error}.", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
