# SPDX-License-Identifier: GPL-3.0-or-later
"""The poses of a recording as training data: the split, and the residuals of partitions."""
