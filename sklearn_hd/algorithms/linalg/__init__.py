"""Triangular factors and sums beyond double precision."""
