# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs: long work with progress, cancellation and an outcome."""
