"""The ball: flight, bounces, impacts and launches."""
