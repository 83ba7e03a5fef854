"""Zenoh queries: received, queued, answered exactly once or refused."""
