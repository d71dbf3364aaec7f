"""Temporal confidence: the paper's Section 3.2 and 3.3 as equations on tensors, and the state that they evolve."""
