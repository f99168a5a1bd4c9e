# SPDX-License-Identifier: GPL-3.0-or-later
"""The manual as a page for browsers: every heading can be reached, and nothing of Markdown is left over."""

import re
from pathlib import Path

from fdda_addon.core.manual_page import heading_anchor, make_page

ROOT = Path(__file__).resolve().parents[2]
MANUAL = (ROOT / "docs" / "manual.md").read_text(encoding="utf-8")


def test_the_whole_manual():
    made = make_page(MANUAL, "file:///docs")
    headings = re.findall(r"^#{1,6} (.+)$", MANUAL, re.MULTILINE)
    assert len(headings) > 60
    assert [heading for heading in headings if f'id="{heading_anchor(heading)}"' not in made] == []
    text = re.sub(r"<pre>.*?</pre>|<code>.*?</code>", "", made, flags=re.DOTALL)
    assert [line for line in text.splitlines() if "**" in line or "](" in line or line.startswith(("|", "- "))] == []
    assert made.count("<table>") >= 4 and "file:///docs/pictures/" in made
    for name in re.findall(r'href="#([^"]+)"', made):
        assert f'id="{name}"' in made, name


def test_blocks():
    listed = "- i\n  more\n- j\n\n1. k"
    table = "| a | b |\n|---|---|\n| 1 | 2 |"
    made = make_page(f"# A <b>\n\none\ntwo `**x**` & **b**\n{listed}\n\n    code **x**\n\n{table}", "f")
    assert '<h1 id="a-b">A &lt;b&gt;</h1>' in made
    assert "<p>one two <code>**x**</code> &amp; <b>b</b></p>" in made
    assert "<ul><li>i more</li><li>j</li></ul>" in made and "<ol><li>k</li></ol>" in made
    assert "<pre>code **x**</pre>" in made and "<tr><td>1</td><td>2</td></tr>" in made
