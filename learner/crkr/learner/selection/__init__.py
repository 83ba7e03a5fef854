"""Rules that choose the active samples: Adaptive Non-Maximal Suppression and what it is compared with."""
