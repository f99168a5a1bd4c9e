# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: one module per verb with its options and its `run`; `main` imports it."""
