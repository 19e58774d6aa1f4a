"""Periodic systems: Floquet analysis, harmonic decomposition, realization from once a period."""
