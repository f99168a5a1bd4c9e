# SPDX-License-Identifier: GPL-3.0-or-later
"""Safe reading and writing of files, and the processes that do it."""
