"""Requests, answers and publications as values that are checked once."""
