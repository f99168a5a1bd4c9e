# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line. Each verb has a module with its options and its `run`, which `main` imports."""
