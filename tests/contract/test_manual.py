# SPDX-License-Identifier: GPL-3.0-or-later
"""The manual uses the names, messages and settings of the user interface, and all links of the documentation work."""

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from fdda_addon.panels import MODULES as SECTION_MODULES

ROOT = Path(__file__).resolve().parents[2]
ADDON = ROOT / "fdda_addon"
MANUAL = (ROOT / "docs" / "manual.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]

INTERFACE_FILES = [
    *(ADDON / "panels").glob("*.py"),
    *(ADDON / "operators").glob("*.py"),
    *sorted((ADDON / "properties").glob("*.py")),
]
REPORT_TEMPLATE = ROOT / "trainer" / "report" / "page.html"
MESSAGE_FILES = list(ADDON.rglob("*.py"))
EXAMPLES_OF_BOLD_TEXT = {"bold"}
"""Bold words of the manual that explain its notation and are no labels."""

MIN_CAUSE_WORDS = 3
VALUE_PLACEHOLDER = "\0"
"""Placeholder for a value of an f-string."""


def parse(path: Path) -> ast.Module:
    """Return the syntax tree of a Python file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def text_template(node: ast.expr) -> str | None:
    """Return the text of a string or f-string, with `VALUE_PLACEHOLDER` for values; None for other expressions."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(text_template(part) or VALUE_PLACEHOLDER for part in node.values)
    return None


def text_templates(paths: list[Path]) -> Iterator[str]:
    """Yield all texts in source files, without docstrings."""
    for path in paths:
        nodes = list(ast.walk(parse(path)))
        docstring_ids = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        yield from (text for node in nodes if id(node) not in docstring_ids and (text := text_template(node)))


def template_pattern(text: str) -> re.Pattern:
    """Compile a text template into a pattern in which values match anything."""
    return re.compile(".+".join(map(re.escape, text.split(VALUE_PLACEHOLDER))))


def bold_texts() -> set[str]:
    """Return the bold texts of the manual, outside of code."""
    text = re.sub(r"`[^`]*`|^    .*$", "", MANUAL, flags=re.MULTILINE)
    return {" ".join(bold_text.split()) for bold_text in re.findall(r"\*\*(.+?)\*\*", text, re.DOTALL)}


def headings(text: str, level: str = "#{1,6}") -> list[str]:
    """Return the headings of a page that have this level, a pattern of number signs."""
    return re.findall(rf"^{level} (.+)$", text, re.MULTILINE)


def anchor(heading: str) -> str:
    """Return the anchor of a heading, as GitHub generates it for links."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def label_patterns() -> list[re.Pattern]:
    """Return patterns of all texts that the interface and the training report may show."""
    report_headings = re.findall(r"<h2>(.*?)</h2>", REPORT_TEMPLATE.read_text(encoding="utf-8"))
    texts = [*text_templates(INTERFACE_FILES), *report_headings]
    # A template without words would match any text.
    return [template_pattern(text) for text in texts if re.search(r"\w\w", text)]


def operator_labels() -> dict[str, str]:
    """Return the `bl_label` of each operator by its `bl_idname`."""
    labels = {}
    for path in (ADDON / "operators").glob("*.py"):
        for cls in (node for node in parse(path).body if isinstance(node, ast.ClassDef)):
            class_attributes = {
                ast.unparse(n.targets[0]): text_template(n.value) for n in cls.body if isinstance(n, ast.Assign)
            }
            if "bl_idname" in class_attributes:
                labels[class_attributes["bl_idname"]] = class_attributes["bl_label"]
    return labels


def button_texts() -> Iterator[list[str]]:
    """Yield the possible texts of each button in the panels, except icons and buttons with a computed text."""
    labels = operator_labels()
    for path in (ADDON / "panels").glob("*.py"):
        for node in ast.walk(parse(path)):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                continue
            if node.func.attr != "operator" or text_template(node.args[0]) not in labels:
                continue
            text = next((keyword.value for keyword in node.keywords if keyword.arg == "text"), None)
            choices = [text.body, text.orelse] if isinstance(text, ast.IfExp) else [text]
            texts = (
                [labels[text_template(node.args[0])]] if text is None else [text_template(choice) for choice in choices]
            )
            if all(texts):
                yield texts


def test_bold_texts_are_labels_of_the_interface():
    patterns = label_patterns()
    assert [
        text
        for text in sorted(bold_texts() - EXAMPLES_OF_BOLD_TEXT)
        if not any(label.fullmatch(text) for label in patterns)
    ] == []


def test_every_section_has_a_chapter_in_order():
    titles = []
    for name in SECTION_MODULES:
        for node in ast.walk(parse(ADDON / "panels" / f"{name}.py")):
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "bl_label":
                titles.append(text_template(node.value))
    assert [heading for heading in headings(MANUAL, "###") if heading in titles] == titles


def test_every_button_is_in_the_manual():
    manual_texts = bold_texts()
    assert [
        texts
        for texts in button_texts()
        if not any(template_pattern(template).fullmatch(text) for template in texts for text in manual_texts)
    ] == []
    assert len(list(button_texts())) > 20


def test_names_of_zips_have_the_version_of_the_manifest():
    version = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))["version"]
    assert set(re.findall(r"fdda_addon-([\d.]+)-", MANUAL)) == {version}


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_link_targets_exist(path: Path):
    text = path.read_text(encoding="utf-8")
    broken_links = []
    for link in re.findall(r"\]\(([^)]+)\)|(?:src|href)=\"([^\"]+)\"", re.sub(r"```.*?```", "", text, flags=re.DOTALL)):
        target, _, name = "".join(link).partition("#")
        file = path.parent / target if target else path
        if "://" in target:
            continue
        if not file.is_file() or (name and name not in map(anchor, headings(file.read_text(encoding="utf-8")))):
            broken_links.append("".join(link))
    assert broken_links == []


def test_every_page_is_linked():
    """Each page is linked from the README or from another page."""
    linked_pages = {
        (path.parent / target).resolve()
        for path in PAGES
        for target in re.findall(r"\]\(([^)#]+)", path.read_text(encoding="utf-8"))
        if "://" not in target
    }
    assert [path.name for path in PAGES[1:] if path not in linked_pages] == []
