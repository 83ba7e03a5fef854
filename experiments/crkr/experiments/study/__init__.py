"""Compares rules for the active set with ANMS on the same trials."""
