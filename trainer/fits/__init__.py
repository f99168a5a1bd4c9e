# SPDX-License-Identifier: GPL-3.0-or-later
"""Everything that is fitted before the networks are trained: the linear fit, components, low-rank factors."""
