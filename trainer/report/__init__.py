# SPDX-License-Identifier: GPL-3.0-or-later
"""The report of a training: its content, its page, and the analysis of the largest errors."""
