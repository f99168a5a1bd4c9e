# SPDX-License-Identifier: GPL-3.0-or-later
"""The seeded faults match the code: the text of each fault occurs once in its file, and its tests exist."""

import ast
import re

import pytest

from benchmarks.faults import ROOT, Fault, read_faults

FAULTS = read_faults()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.id)
def test_the_text_of_a_fault_occurs_once(fault: Fault):
    text = (ROOT / fault.file).read_text(encoding="utf-8")
    assert text.count(fault.old) == 1, fault.file
    # The changed code must be valid and different; any test would catch a syntax error.
    assert ast.dump(ast.parse(fault.applied(text))) != ast.dump(ast.parse(text))


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.id)
def test_the_tests_that_catch_a_fault_exist(fault: Fault):
    assert fault.tests
    assert [test for test in fault.tests if not (ROOT / test).is_file()] == []


def test_ids_of_faults_are_unique():
    assert len({fault.id for fault in FAULTS}) == len(FAULTS)


def test_the_development_page_lists_each_fault():
    page = (ROOT / "docs" / "development.md").read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| `([\w-]+)` \| .* \| `([\w/.]+)` \| \d+ \|$", page.partition("### Seeded faults")[2], re.MULTILINE
    )
    assert rows == [(fault.id, fault.tests[0]) for fault in FAULTS]
