"""Simulated and measured records: make_* computes them with the truth, load_* reads them."""

from sklearn_hd.datasets._flapping_wing import make_flapping_wing

__all__ = ["make_flapping_wing"]
