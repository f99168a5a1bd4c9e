# SPDX-License-Identifier: GPL-3.0-or-later
"""A table that a benchmark writes into a page of the documentation, between two lines that mark its place."""

from pathlib import Path
from typing import NamedTuple


class PageTable(NamedTuple):
    """The place of a table in a page.

    Attributes:
        page: the Markdown file.
        start, end: the lines before and after the table.
    """

    page: Path
    start: str
    end: str

    def check(self) -> None:
        """Check, before hours of measurements, that the page has the place.

        Raises:
            SystemExit: it lacks one of the lines, or has them in another order.
        """
        before, start, rest = self.page.read_text(encoding="utf-8").partition(self.start)
        if not start or self.end in before or self.end not in rest:
            raise SystemExit(
                f"'{self.page}' lacks the lines '{self.start}' and '{self.end}', between which the table is written; "
                "add them."
            )

    def write(self, table: str) -> None:
        """Replace the table of the page.

        Raises:
            SystemExit: as `check`; the page is unchanged.
        """
        self.check()
        before, _, rest = self.page.read_text(encoding="utf-8").partition(self.start)
        after = rest.partition(self.end)[2]
        self.page.write_text(f"{before}{self.start}\n\n{table}\n\n{self.end}{after}", encoding="utf-8")
