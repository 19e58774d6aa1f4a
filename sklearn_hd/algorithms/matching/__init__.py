"""A structure matched to a model in the H-infinity norm."""
