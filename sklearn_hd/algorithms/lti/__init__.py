"""Linear time-invariant models: responses, norms, reduction."""
