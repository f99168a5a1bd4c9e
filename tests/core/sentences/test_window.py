# SPDX-License-Identifier: GPL-3.0-or-later
"""The window names its own fields in place of options of the command line."""

import pytest

from fdda_addon.core.sentences.window import for_window


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "have one fitted (--base-skinning smooth, or Base Skinning in the sidebar), or paint weights.",
            "have one fitted (Base Skinning in the sidebar), or paint weights.",
        ),
        ("keep more bones with --controls collection:NAME.", "keep more bones with Bone Collection."),
        (
            "0 poses and no action; give --poses or --action.",
            "0 poses and no action; set Random Poses, or check an action.",
        ),
        (
            "continue it with --resume, or replace it with --overwrite.",
            "continue it with Resume, or replace it with Overwrite.",
        ),
        ("make room and run the command again, `record` with --resume.", "make room and press Resume."),
        ("more frames (--settle-frames) let them rest", "more frames (Settle) let them rest"),
        (
            "or record actions alone, with 0 random poses (--action NAME --poses 0).",
            "or record actions alone, with Random Poses at 0.",
        ),
        (
            "record more poses (--poses), or train longer (--passes)",
            "record more poses (Random Poses), or train longer (Training Passes)",
        ),
        (
            "more bones (--bones-to-pose), or --min-vertices-per-part 8",
            "more bones (Bones to Pose), or Min Vertices per Part 8",
        ),
        ("The file 'a--b.blend' -- or none - stays.", "The file 'a--b.blend' -- or none - stays."),
    ],
)
def test_options_become_labels(text, expected):
    assert for_window(text) == expected
