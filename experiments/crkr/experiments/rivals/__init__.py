"""Alternatives to crkr, behind one interface and on the same trials."""
