"""Parts of step 4: which modes are the machine's own, and their refinement on the raw record."""
