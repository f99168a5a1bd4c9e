# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that opens the manual in the web browser. The manual is part of the add-on."""

import tempfile
from pathlib import Path

import bpy

from ..core.errors import OutputError
from ..core.files.output import write_text
from ..core.sentences import manual_page

MANUAL = Path(__file__).resolve().parents[2] / "docs" / "manual.md"


class FDDA_OT_help(bpy.types.Operator):
    bl_idname = "fdda.help"
    bl_label = "Manual"
    bl_description = "Open the manual in the web browser, at this section"
    bl_options = {"REGISTER"}

    section: bpy.props.StringProperty(
        name="Section", description="Heading in the manual. Empty for its beginning", options={"SKIP_SAVE"}
    )

    def execute(self, _context: bpy.types.Context) -> set[str]:
        try:
            path = manual_file()
        except (OSError, OutputError) as error:
            self.report({"ERROR"}, f"The manual cannot be opened ({error}).")
            return {"CANCELLED"}
        url = path.as_uri() + (f"#{manual_page.heading_anchor(self.section)}" if self.section else "")
        try:
            bpy.ops.wm.url_open(url=url)
        except RuntimeError:
            self.report({"ERROR"}, f"No web browser could be started; open '{path}' yourself.")
            return {"CANCELLED"}
        self.report({"INFO"}, f"Opened {url} in the web browser.")
        return {"FINISHED"}


def manual_file() -> Path:
    """Write the manual as an HTML page and return its path. The pictures stay in the add-on."""
    text = MANUAL.read_text(encoding="utf-8")
    folder = Path(bpy.app.tempdir or tempfile.gettempdir())
    path = folder / "fdda_manual.html"
    write_text(path, manual_page.make_page(text, MANUAL.parent.as_uri()))
    return path


CLASSES = (FDDA_OT_help,)
