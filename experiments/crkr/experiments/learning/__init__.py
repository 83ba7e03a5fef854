"""Whole runs of learning without a server, over many seeds."""
