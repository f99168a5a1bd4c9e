# SPDX-License-Identifier: GPL-3.0-or-later
"""The ONNX graph of a trained model, its comparison with PyTorch, and its file."""
