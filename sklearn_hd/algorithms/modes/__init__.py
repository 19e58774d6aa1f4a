"""Modes of identified models: which are the machine's, which the analyzer's."""
