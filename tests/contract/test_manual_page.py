# SPDX-License-Identifier: GPL-3.0-or-later
"""The manual as an HTML page: every heading has an anchor, and no Markdown remains."""

import re

from .test_setup import ROOT, load_script

manual_page = load_script("manual_page")
heading_anchor, make_page = manual_page.heading_anchor, manual_page.make_page
MANUAL = (ROOT / "docs" / "manual.md").read_text(encoding="utf-8")


def test_the_manual_is_converted_completely():
    html_page = make_page(MANUAL)
    headings = re.findall(r"^#{1,6} (.+)$", MANUAL, re.MULTILINE)
    assert len(headings) > 60
    assert [heading for heading in headings if f'id="{heading_anchor(heading)}"' not in html_page] == []
    text = re.sub(r"<pre>.*?</pre>|<code>.*?</code>", "", html_page, flags=re.DOTALL)
    assert [line for line in text.splitlines() if "**" in line or "](" in line or line.startswith(("|", "- "))] == []
    assert html_page.count("<table>") >= 4 and 'src="pictures/' in html_page
    for name in re.findall(r'href="#([^"]+)"', html_page):
        assert f'id="{name}"' in html_page, name


def test_headings_paragraphs_lists_code_and_tables_are_converted():
    lists = "- i\n  more\n- j\n\n1. k"
    table = "| a | b |\n|---|---|\n| 1 | 2 |"
    html_page = make_page(f"# A <b>\n\none\ntwo `**x**` & **b**\n{lists}\n\n    code **x**\n\n{table}")
    assert '<h1 id="a-b">A &lt;b&gt;</h1>' in html_page
    assert "<p>one two <code>**x**</code> &amp; <b>b</b></p>" in html_page
    assert "<ul><li>i more</li><li>j</li></ul>" in html_page and "<ol><li>k</li></ol>" in html_page
    assert "<pre>code **x**</pre>" in html_page and "<tr><td>1</td><td>2</td></tr>" in html_page
