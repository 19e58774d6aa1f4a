"""Parts of step 5: structures matched in a norm, periodic models, maximum likelihood."""
