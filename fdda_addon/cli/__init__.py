# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: one verb a file, each with its options and what it runs; `main` finds it."""
