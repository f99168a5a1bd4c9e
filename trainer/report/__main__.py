# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes the page of a report again: `python -m trainer.report REPORT.json`. It does not need torch."""

import argparse
import sys
from pathlib import Path

from fdda_addon.core.errors import FDDAError, TrainingError
from fdda_addon.core.files.file_kind import PAGE
from fdda_addon.core.files.output import check_outputs, write_text
from fdda_addon.core.files.terminal import escape_unencodable_output
from fdda_addon.core.formats.report import page_path, read_evaluation, read_report

from ..process import missing_package_error


def main(arguments: list[str] | None = None) -> int:
    """Run `python -m trainer.report REPORT.json`, which writes the page again; returns the exit status."""
    escape_unencodable_output()
    parser = argparse.ArgumentParser("trainer.report", description="Write the page of a training report again.")
    parser.add_argument("report", type=Path, help="report.json; the page is written beside it")
    parser.add_argument("--pictures", type=Path, help="folder of PNG or JPEG files to show, in order of their names")
    parser.add_argument("--evaluation", type=Path, help="JSON that evaluate wrote")
    parser.add_argument("--overwrite", action="store_true", help="overwrite a page that is no report")
    try:
        _write_page(parser.parse_args(arguments))
    except FDDAError as error:
        print(error, file=sys.stderr)
        return 1
    except OSError as error:
        print(f"A picture cannot be read: {error}.", file=sys.stderr)
        return 1
    return 0


def _write_page(options: argparse.Namespace) -> None:
    try:
        from jinja2 import TemplateError

        from .page import render_html
    except ModuleNotFoundError as error:
        raise missing_package_error("The page of a report", error) from error
    page = page_path(options.report)
    check_outputs({page: PAGE}, [options.report], options.overwrite)
    report = read_report(options.report)
    pictures = []
    if options.pictures:
        pictures = sorted(p for p in options.pictures.glob("*") if p.suffix.lower() in (".png", ".jpg", ".jpeg"))
    evaluation = read_evaluation(options.evaluation) if options.evaluation else None
    try:
        html = render_html(report, pictures, evaluation)
    except (ArithmeticError, IndexError, ValueError, TemplateError) as error:
        raise TrainingError(
            f"The report '{options.report}' is damaged: its figures contradict each other; train again."
        ) from error
    write_text(page, html)


if __name__ == "__main__":
    sys.exit(main())
