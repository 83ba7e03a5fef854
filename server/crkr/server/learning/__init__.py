"""Learning from the log: the thread, fits, restarts, and the tasks that are served."""
