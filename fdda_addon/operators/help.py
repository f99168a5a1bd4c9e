# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that opens the manual in the web browser. The manual is part of the add-on."""

from pathlib import Path

import bpy

_DOCS = Path(__file__).resolve().parents[2] / "docs"


class FDDA_OT_help(bpy.types.Operator):
    bl_idname = "fdda.help"
    bl_label = "Manual"
    bl_description = "Open the manual in the web browser, at this section"
    bl_options = {"REGISTER"}

    section: bpy.props.StringProperty(
        name="Section", description="Heading in the manual. Empty for its beginning", options={"SKIP_SAVE"}
    )

    def execute(self, _context: bpy.types.Context) -> set[str]:
        path = manual_path()
        url = path.as_uri() + (f"#{self.section.lower().replace(' ', '-')}" if self.section else "")
        try:
            bpy.ops.wm.url_open(url=url)
        except RuntimeError:
            self.report({"ERROR"}, f"No web browser could be started; open '{path}' yourself.")
            return {"CANCELLED"}
        self.report({"INFO"}, f"Opened {url} in the web browser.")
        return {"FINISHED"}


def manual_path() -> Path:
    """Return the path of the manual: the page that the zip has, or its source in a checkout."""
    page = _DOCS / "manual.html"
    return page if page.is_file() else _DOCS / "manual.md"


CLASSES = (FDDA_OT_help,)
