# SPDX-License-Identifier: GPL-3.0-or-later
"""The input features of the networks."""
