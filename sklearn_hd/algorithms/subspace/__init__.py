"""Subspace identification: data matrices, projections, state matrices, B and D."""
