"""Temporal confidence: the paper's Sections 3.2 and 3.3.

`equations` holds the formulas, on tensors; `state` holds what is remembered of each Gaussian and composes them.
"""
