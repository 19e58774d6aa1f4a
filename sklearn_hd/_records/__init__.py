"""From the user's rows to evenly sampled segments, small-signal pairs and initial states."""
