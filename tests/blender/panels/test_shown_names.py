# SPDX-License-Identifier: GPL-3.0-or-later
"""Names of bones in the narrow tables of the sidebar."""

import pytest

from fdda_addon.panels.bone_names import common_prefix


@pytest.mark.parametrize(
    ("names", "prefix"),
    [
        (["mixamorig:Hips", "mixamorig:LeftArm", "mixamorig:LeftHandIndex1"], "mixamorig:"),
        (["root", *(f"char01:body:{n}" for n in "abcdefg")], "char01:body:"),
        (["DEF-spine", "DEF-upper_arm.L", "DEF-upper_arm.R"], "DEF-"),
        (["CC_Base_Hip", "CC_Base_Waist", "CC_Base_L_Thigh"], "CC_Base_"),
        (["upper", "lower"], ""),
        (["thumb_1", "thumb_2"], "thumb_"),
        (["a_1", "a_2"], ""),
        (["arm"], ""),
        (["x:a", "b", "c", "d"], ""),
        ([], ""),
    ],
)
def test_the_common_prefix_of_bone_names_is_omitted(names, prefix):
    assert common_prefix(names) == prefix
