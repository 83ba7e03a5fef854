"""Durations, counts and the Prometheus endpoint."""
