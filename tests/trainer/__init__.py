# SPDX-License-Identifier: GPL-3.0-or-later
"""The tests of the training, the export and the report."""
