"""Inspection of an existing log: verification, seals, and stored runs."""
