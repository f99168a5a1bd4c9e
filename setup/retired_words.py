# SPDX-License-Identifier: GPL-3.0-or-later
"""`python setup/retired_words.py`: find retired words in code and documents, and print their replacements.

Retired words are words that the field does not use. Exit status: 0 if none is found, 1 if some are found.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("fdda_addon", "trainer", "farm", "tests", "benchmarks", "blend_fixtures", "setup", "examples", "docs")
SUFFIXES = {".py", ".md", ".toml", ".mjs", ".js", ".html", ".c", ""}
"""Suffixes of the files that are searched; scripts have none."""
EXTRA_FILES = ("Makefile", "pyproject.toml", ".ci/run")
"""Searched files outside `FOLDERS`."""
GENERATED_FOLDERS = {"node_modules", "__pycache__", "dist"}

REPLACEMENTS = {
    r"linear[ _]layers?|LinearLayer": "linear skinning (a linear layer is torch.nn.Linear)",
    r"target[-_]mm": "goal-mm (a target is an object that is recorded)",
    r"last weights|LastWeights": "checkpoint",
    r"cache object": "position buffer",
    r"live binding|LiveBinding": "player",
    r"held[ _]back": "held out",
    r"trust in (this|the) pose|trusted range": "confidence, trained range",
    r"least[ -]vertices": "min-partition-vertices",
    r"still[-_]mm": "rest-threshold-mm",
    r"look_again|make_anew|take_news|give_back_rigs": "a verb of programming: request_rescan, recreate_player, …",
    r"what is none|so many of": "the noun that is meant",
    r"colour|\bgrey|centre|neighbour|normalis|standardis|recognis|minimis|licence\b|labelled": "the US spelling",
    r"\blearnt\b": "learned",
    r"\b(?-i:([Mm]illi|[Cc]enti|[Kk]ilo)?[Mm]etres?)\b(?!-per-unit)": "meter (not in metres_per_unit)",
    r"(?<![\w\"`])(?-i:cancell(ed|ing))\b(?![\"`])": "canceled, canceling",
}
"""Regular expressions of retired words, without regard to case, and their replacements."""


def list_files() -> list[Path]:
    """List the files that people write, without this one."""
    root_files = [*ROOT.glob("*.md"), *(ROOT / name for name in EXTRA_FILES)]
    files = [*root_files, *(path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*")))]
    return [
        path
        for path in files
        if path.suffix in SUFFIXES
        and path.is_file()
        and path != Path(__file__).resolve()
        and not GENERATED_FOLDERS.intersection(path.parts)
    ]


def find_retired_words(text: str) -> list[tuple[int, str, str]]:
    """Return the line and the text of each retired word, and its replacement."""
    matches = []
    for pattern, replacement in REPLACEMENTS.items():
        for match in re.finditer(pattern, text, re.IGNORECASE):
            matches.append((text.count("\n", 0, match.start()) + 1, match[0], replacement))
    return sorted(matches)


def main() -> int:
    """Print a line for each retired word."""
    lines = [
        f"{path.relative_to(ROOT)}:{line}: '{word}': write {replacement}"
        for path in list_files()
        for line, word, replacement in find_retired_words(path.read_text(encoding="utf-8", errors="replace"))
    ]
    print("\n".join(lines), end="\n" if lines else "")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
