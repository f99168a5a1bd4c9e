# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes the meshes as models deform them to Alembic and USD files, which play without models."""
