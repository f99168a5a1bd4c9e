# SPDX-License-Identifier: GPL-3.0-or-later
"""Conversion of the manual to an HTML page, for the subset of Markdown that it uses."""

import html
import re

STYLE = (
    "body{max-width:46em;margin:2em auto;padding:0 1em;font:16px/1.5 sans-serif}table{border-collapse:collapse}"
    "td,th{border:1px solid #bbb;padding:.2em .6em;text-align:left}pre{background:#eee;padding:.6em;overflow:auto}"
    "code{background:#eee}img{max-width:100%}h2,h3,h4{margin-top:1.6em}:target{background:#fe8}"
)
_BLOCK_START = r"^(#{1,6} |\||    |<img|- |\d+\. )"


def heading_anchor(heading: str) -> str:
    """Return the HTML anchor of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def make_page(text: str) -> str:
    """Convert Markdown text to an HTML page with the same links and images."""
    body = "\n".join(map(_block_html, _split_blocks(text)))
    return f'<!doctype html><meta charset="utf-8"><title>FDDA</title><style>{STYLE}</style>\n{body}\n'


def _split_blocks(text: str) -> list[list[str]]:
    """Split Markdown text into blocks of lines: headings, tables, lists, code and paragraphs."""
    blocks: list[list[str]] = [[]]
    for line in text.splitlines():
        block_start = re.match(_BLOCK_START, line)
        first_character = block_start[1].strip()[:1] if block_start else ""
        previous_start = re.match(_BLOCK_START, blocks[-1][0]) if blocks[-1] else None
        is_list = previous_start is not None and (previous_start[1] == "- " or previous_start[1][0].isdigit())
        if not line.strip():
            blocks.append([])
        elif is_list and (block_start is None or line.startswith("    ")):
            blocks[-1].append(line)
        elif first_character == "#" or (
            blocks[-1] and block_start and (previous_start is None or previous_start[1][:1] != block_start[1][:1])
        ):
            blocks.append([line])
        else:
            blocks[-1].append(line)
    return [block for block in blocks if block]


def _block_html(lines: list[str]) -> str:
    first = lines[0]
    if heading := re.match(r"(#{1,6}) (.*)", first):
        level = len(heading[1])
        text = _inline_html(" ".join([heading[2], *lines[1:]]))
        return f'<h{level} id="{heading_anchor(heading[2])}">{text}</h{level}>'
    if first.startswith("|"):
        rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
        rows = [row for row in rows if not all(re.fullmatch(r":?-+:?", cell) for cell in row)]
        cells = ["".join(f"<td>{_inline_html(cell)}</td>" for cell in row) for row in rows]
        return "<table>" + "".join(f"<tr>{row}</tr>" for row in cells) + "</table>"
    if first.startswith("    "):
        return f"<pre>{html.escape(chr(10).join(line[4:] for line in lines), quote=False)}</pre>"
    if re.match(r"- |\d+\. ", first):
        items: list[str] = []
        for line in lines:
            if item_match := re.match(r"(?:- |\d+\. )(.*)", line):
                items.append(item_match[1])
            else:
                items[-1] += f" {line.strip()}"
        tag = "ul" if lines[0].startswith("- ") else "ol"
        return f"<{tag}>" + "".join(f"<li>{_inline_html(item)}</li>" for item in items) + f"</{tag}>"
    return f"<p>{_inline_html(' '.join(lines))}</p>"


def _inline_html(text: str) -> str:
    """Convert code, bold text, italic text, links and images inside a block to HTML."""
    fragments: list[str] = []

    def protect(fragment: str) -> str:
        fragments.append(fragment)
        return f"\0{len(fragments) - 1}\0"

    def convert_image(match: re.Match) -> str:
        return protect(f'<img src="{html.escape(match[1])}" alt="{html.escape(match[2])}">')

    def convert_link(match: re.Match) -> str:
        return protect(f'<a href="{html.escape(match[2])}">') + match[1] + protect("</a>")

    text = re.sub(r'<img src="([^"]+)"[^>]*alt="([^"]*)"[^>]*>', convert_image, text)
    text = re.sub(r"`([^`]+)`", lambda match: protect(f"<code>{html.escape(match[1], quote=False)}</code>"), text)
    text = re.sub(r"\[([^\]]+)\]\(([^)]+)\)", convert_link, text)
    text = html.escape(text, quote=False)
    text = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", text)
    text = re.sub(r"\*(\S[^*]*?)\*", r"<i>\1</i>", text)
    return re.sub(r"\0(\d+)\0", lambda match: fragments[int(match[1])], text)
