# SPDX-License-Identifier: GPL-3.0-or-later
"""The manual and the interface agree in names of sections and buttons, sentences and settings; all links lead on."""

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from fdda_addon.core import defaults
from fdda_addon.panels import MODULES as SECTIONS

ROOT = Path(__file__).resolve().parents[2]
ADDON = ROOT / "fdda_addon"
MANUAL = (ROOT / "docs" / "manual.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]

INTERFACE = [
    *(ADDON / "panels").glob("*.py"),
    *(ADDON / "operators").glob("*.py"),
    *sorted((ADDON / "properties").glob("*.py")),
    ROOT / "trainer" / "report_page.py",
]
SENTENCES = list(ADDON.rglob("*.py"))
TOLD_ELSEWHERE = {"bold"}
"""What the manual sets in bold to show what bold means."""

GAP = "\0"
"""Stands for a value in a text that is put together."""


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def template(node: ast.expr) -> str | None:
    """The text of a string, with `GAP` for each value that is put into it; None for anything else."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(template(part) or GAP for part in node.values)
    return None


def templates(paths: list[Path]) -> Iterator[str]:
    """All texts in source files, without docstrings."""
    for path in paths:
        nodes = list(ast.walk(tree(path)))
        statements = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        yield from (text for node in nodes if id(node) not in statements and (text := template(node)))


def pattern(text: str) -> re.Pattern:
    return re.compile(".+".join(map(re.escape, text.split(GAP))))


def bold() -> set[str]:
    """What the manual sets in bold, outside of code."""
    text = re.sub(r"`[^`]*`|^    .*$", "", MANUAL, flags=re.MULTILINE)
    return {" ".join(found.split()) for found in re.findall(r"\*\*(.+?)\*\*", text, re.DOTALL)}


def headings(text: str, level: str = "#{1,6}") -> list[str]:
    return re.findall(rf"^{level} (.+)$", text, re.MULTILINE)


def anchor(heading: str) -> str:
    """The name under which pages link to a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def labels() -> list[re.Pattern]:
    """What the interface and the report may show."""
    texts = (re.sub(r"<h2>(.*?)</h2>.*", r"\1", text, flags=re.DOTALL) for text in templates(INTERFACE))
    # What is all values would match anything.
    return [pattern(text) for text in texts if re.search(r"\w\w", text)]


def operator_labels() -> dict[str, str]:
    """`bl_label` of the operators by `bl_idname`."""
    found = {}
    for path in (ADDON / "operators").glob("*.py"):
        for cls in (node for node in tree(path).body if isinstance(node, ast.ClassDef)):
            own = {ast.unparse(n.targets[0]): template(n.value) for n in cls.body if isinstance(n, ast.Assign)}
            if "bl_idname" in own:
                found[own["bl_idname"]] = own["bl_label"]
    return found


def buttons() -> Iterator[list[str]]:
    """The texts that each button of the panels may have; not those of icons, or whose text comes from elsewhere."""
    known = operator_labels()
    for path in (ADDON / "panels").glob("*.py"):
        for node in ast.walk(tree(path)):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                continue
            if node.func.attr != "operator" or template(node.args[0]) not in known:
                continue
            text = next((keyword.value for keyword in node.keywords if keyword.arg == "text"), None)
            choices = [text.body, text.orelse] if isinstance(text, ast.IfExp) else [text]
            texts = [known[template(node.args[0])]] if text is None else [template(choice) for choice in choices]
            if all(texts):
                yield texts


def properties() -> dict[str, dict]:
    """Arguments of the properties in `settings`, by the name that the sidebar shows; those of one name must agree."""
    shown, found = {}, {}
    for path in (ADDON / "panels").glob("*.py"):
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "prop" and len(node.args) > 1:
                text = [template(keyword.value) for keyword in node.keywords if keyword.arg == "text"]
                if ast.unparse(node.args[0]) == "settings" and text and text[0]:
                    shown[template(node.args[1])] = text[0]
    for node in ast.walk(tree(ADDON / "properties" / "character.py")):
        if isinstance(node, ast.AnnAssign) and isinstance(node.annotation, ast.Call):
            values = {k.arg: k.value.value for k in node.annotation.keywords if isinstance(k.value, ast.Constant)}
            names = {k.arg: k.value.id for k in node.annotation.keywords if isinstance(k.value, ast.Name)}
            values |= {argument: getattr(defaults, name) for argument, name in names.items() if hasattr(defaults, name)}
            found[shown.get(node.target.id, values.get("name"))] = values
    return found


def test_what_is_bold_is_shown():
    known = labels()
    assert [text for text in sorted(bold() - TOLD_ELSEWHERE) if not any(label.fullmatch(text) for label in known)] == []


def test_every_section_has_a_chapter():
    titles = []
    for name in SECTIONS:
        for node in ast.walk(tree(ADDON / "panels" / f"{name}.py")):
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "bl_label":
                titles.append(template(node.value))
    assert [heading for heading in headings(MANUAL, "###") if heading in titles] == titles


def test_every_button_is_described():
    described = bold()
    assert [texts for texts in buttons() if not any(pattern(t).fullmatch(b) for t in texts for b in described)] == []
    assert len(list(buttons())) > 20


def test_quoted_symptoms_are_what_the_addon_says():
    quoted = [heading.strip('"') for heading in headings(MANUAL, "####") if heading.startswith('"')]
    known = list(templates(SENTENCES))
    unknown = [
        text
        for text in quoted
        if not any(re.search(".+".join(map(re.escape, text.split("…"))), one, re.DOTALL) for one in known)
    ]
    assert len(quoted) > 30 and unknown == []


def test_settings_are_those_of_the_sidebar():
    rows = re.findall(r"^\| \*\*(.+?)\*\* \| ([\d.]+) \| (.+) \|$", MANUAL, re.MULTILINE)
    known = properties()
    assert len(rows) == 8
    for name, default, text in rows:
        assert float(default) == known[name].get("default", 0), name
        if limits := re.match(r"([\d.]+) to ([\d.]+):", text):
            assert [float(limit) for limit in limits.groups()] == [known[name]["min"], known[name]["max"]], name


def test_figures_are_those_of_the_benchmarks():
    measured = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    times = re.findall(r"^\| ([\d,]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+)", MANUAL, re.MULTILINE)
    assert len(times) == 3
    assert [figure for row in times for figure in row if figure not in measured] == []
    text = " ".join(MANUAL.split())
    beyond = re.findall(r"(\d+) %(?: of that of linear skinning)? at ([\d.]+) times", text)
    assert len(beyond) == 3
    for part, factor in beyond:
        assert re.search(rf"{factor} times the range of motion \|[^|]*\|[^|]*\| {part} %", measured), factor


def test_the_zip_has_the_version_of_the_manifest():
    version = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))["version"]
    assert set(re.findall(r"fdda_addon-([\d.]+)-", MANUAL)) == {version}


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_every_link_leads_somewhere(path: Path):
    text = path.read_text(encoding="utf-8")
    wrong = []
    for link in re.findall(r"\]\(([^)]+)\)|(?:src|href)=\"([^\"]+)\"", re.sub(r"```.*?```", "", text, flags=re.DOTALL)):
        target, _, name = "".join(link).partition("#")
        file = path.parent / target if target else path
        if "://" in target:
            continue
        if not file.is_file() or (name and name not in map(anchor, headings(file.read_text(encoding="utf-8")))):
            wrong.append("".join(link))
    assert wrong == []


def test_every_page_can_be_found():
    """Each is linked from the README or from another page."""
    linked = {
        (path.parent / target).resolve()
        for path in PAGES
        for target in re.findall(r"\]\(([^)#]+)", path.read_text(encoding="utf-8"))
        if "://" not in target
    }
    assert [path.name for path in PAGES[1:] if path not in linked] == []
