# SPDX-License-Identifier: GPL-3.0-or-later
"""What the sources, the pages and the set-up keep to."""
