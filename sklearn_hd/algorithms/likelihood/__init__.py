"""Maximum likelihood of the parameters of a structure, from records."""
