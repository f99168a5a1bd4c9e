# SPDX-License-Identifier: GPL-3.0-or-later
"""The tests of the examples of docs/formats.md."""
