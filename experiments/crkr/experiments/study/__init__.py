"""Rules for the active set beside ANMS, and what each learns with the same trials."""
