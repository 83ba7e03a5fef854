"""Pictures and films of trials, for every skill that offers shapes and motion."""
