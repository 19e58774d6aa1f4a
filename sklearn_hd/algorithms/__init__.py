"""Pure functions of the five steps: arrays in, arrays out, one mathematical object a file."""
