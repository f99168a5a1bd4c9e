# SPDX-License-Identifier: GPL-3.0-or-later
"""The mathematics of the deformation: arrays in, arrays out."""
