# SPDX-License-Identifier: GPL-3.0-or-later
"""Conversion of the manual to an HTML page, for the subset of Markdown that it uses."""

import html
import re

STYLE = (
    "body{max-width:46em;margin:2em auto;padding:0 1em;font:16px/1.5 sans-serif}table{border-collapse:collapse}"
    "td,th{border:1px solid #bbb;padding:.2em .6em;text-align:left}pre{background:#eee;padding:.6em;overflow:auto}"
    "code{background:#eee}img{max-width:100%}h2,h3,h4{margin-top:1.6em}:target{background:#fe8}"
)
_BLOCK = r"^(#{1,6} |\||    |<img|- |\d+\. )"


def heading_anchor(heading: str) -> str:
    """Return the anchor of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def make_page(text: str, folder: str) -> str:
    """Convert Markdown text to a page; relative links and images are resolved against the URL `folder`."""
    body = "\n".join(_block(block, folder) for block in _blocks(text))
    return f'<!doctype html><meta charset="utf-8"><title>FDDA</title><style>{STYLE}</style>\n{body}\n'


def _blocks(text: str) -> list[list[str]]:
    """Split lines into blocks: heading, table, list, code or paragraph."""
    blocks: list[list[str]] = [[]]
    for line in text.splitlines():
        own = re.match(_BLOCK, line)
        kind = own[1].strip()[:1] if own else ""
        previous = re.match(_BLOCK, blocks[-1][0]) if blocks[-1] else None
        is_list = previous is not None and (previous[1] == "- " or previous[1][0].isdigit())
        if not line.strip():
            blocks.append([])
        elif is_list and (own is None or line.startswith("    ")):
            blocks[-1].append(line)
        elif kind == "#" or (blocks[-1] and own and (previous is None or previous[1][:1] != own[1][:1])):
            blocks.append([line])
        else:
            blocks[-1].append(line)
    return [block for block in blocks if block]


def _block(lines: list[str], folder: str) -> str:
    first = lines[0]
    if heading := re.match(r"(#{1,6}) (.*)", first):
        level = len(heading[1])
        text = _inline(" ".join([heading[2], *lines[1:]]), folder)
        return f'<h{level} id="{heading_anchor(heading[2])}">{text}</h{level}>'
    if first.startswith("|"):
        return _table(lines, folder)
    if first.startswith("    "):
        return f"<pre>{html.escape(chr(10).join(line[4:] for line in lines), quote=False)}</pre>"
    if re.match(r"- |\d+\. ", first):
        return _list(lines, folder)
    return f"<p>{_inline(' '.join(lines), folder)}</p>"


def _table(lines: list[str], folder: str) -> str:
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    rows = [row for row in rows if not all(re.fullmatch(r":?-+:?", cell) for cell in row)]
    cells = ["".join(f"<td>{_inline(cell, folder)}</td>" for cell in row) for row in rows]
    return "<table>" + "".join(f"<tr>{row}</tr>" for row in cells) + "</table>"


def _list(lines: list[str], folder: str) -> str:
    items: list[str] = []
    for line in lines:
        if own := re.match(r"(?:- |\d+\. )(.*)", line):
            items.append(own[1])
        else:
            items[-1] += f" {line.strip()}"
    kind = "ul" if lines[0].startswith("- ") else "ol"
    return f"<{kind}>" + "".join(f"<li>{_inline(item, folder)}</li>" for item in items) + f"</{kind}>"


def _inline(text: str, folder: str) -> str:
    """Convert code, bold, italic, links and images."""
    kept: list[str] = []

    def keep(made: str) -> str:
        kept.append(made)
        return f"\0{len(kept) - 1}\0"

    def picture(match: re.Match) -> str:
        return keep(f'<img src="{folder}/{html.escape(match[1])}" alt="{html.escape(match[2])}">')

    def link(match: re.Match) -> str:
        target = match[2] if match[2].startswith("#") or "://" in match[2] else f"{folder}/{match[2]}"
        return keep(f'<a href="{html.escape(target)}">') + match[1] + keep("</a>")

    text = re.sub(r'<img src="([^"]+)"[^>]*alt="([^"]*)"[^>]*>', picture, text)
    text = re.sub(r"`([^`]+)`", lambda match: keep(f"<code>{html.escape(match[1], quote=False)}</code>"), text)
    text = re.sub(r"\[([^\]]+)\]\(([^)]+)\)", link, text)
    text = html.escape(text, quote=False)
    text = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", text)
    text = re.sub(r"\*(\S[^*]*?)\*", r"<i>\1</i>", text)
    return re.sub(r"\0(\d+)\0", lambda match: kept[int(match[1])], text)
