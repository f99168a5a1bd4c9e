# SPDX-License-Identifier: GPL-3.0-or-later
"""`python setup/retired_words.py`: find words in code and docs that the field does not use, and name those it uses.

Exit status: 0 none found, 1 some found, a line each.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("fdda_addon", "trainer", "farm", "tests", "benchmarks", "blend_fixtures", "setup", "examples", "docs")
SUFFIXES = {".py", ".md", ".toml", ".mjs", ".html"}

RETIRED = {
    r"linear[ _]layers?|LinearLayer": "linear skinning (a linear layer is torch.nn.Linear)",
    r"target[-_]mm": "goal-mm (a target is an object that is recorded)",
    r"last weights|LastWeights": "checkpoint",
    r"cache object": "position buffer",
    r"live binding|LiveBinding": "player",
    r"held[ _]back": "held out",
    r"trust in (this|the) pose|trusted range": "confidence, trained range",
    r"least[ -]vertices": "min-partition-vertices",
    r"still[-_]mm": "rest-threshold-mm",
    r"influences[-_]only": "detect-influences",
    r"look_again|make_anew|take_news|give_back_rigs": "a verb of programming: request_rescan, recreate_player, …",
    r"what is none|so many of": "the noun that is meant",
    r"colour|\bgrey|centre|neighbour|normalis|standardis|recognis|minimis|licence\b|labelled": "the US spelling",
    r"\blearnt\b": "learned",
}
"""Regular expressions, without regard to case, and what to write."""


def files() -> list[Path]:
    """Return the files that people write, without this one."""
    pages = [path for path in ROOT.glob("*.md")]
    below = (path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*")))
    found = (path for path in [*pages, *below] if path.suffix in SUFFIXES and path != Path(__file__).resolve())
    return [path for path in found if "node_modules" not in path.parts]


def find(text: str) -> list[tuple[int, str, str]]:
    """Return the retired words of a text: line, word, and what to write."""
    found = []
    for pattern, replacement in RETIRED.items():
        for match in re.finditer(pattern, text, re.IGNORECASE):
            found.append((text.count("\n", 0, match.start()) + 1, match[0], replacement))
    return sorted(found)


def main() -> int:
    """Print a line for each retired word."""
    lines = [
        f"{path.relative_to(ROOT)}:{line}: '{word}': write {replacement}"
        for path in files()
        for line, word, replacement in find(path.read_text(encoding="utf-8"))
    ]
    print("\n".join(lines), end="\n" if lines else "")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
