"""Rules that choose the active samples: Adaptive Non-Maximal Suppression and simpler ones."""
