"""Tables and their index as users give them, read as floats and seconds."""
