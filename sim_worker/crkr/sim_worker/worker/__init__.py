"""A worker process: the trial loop and its link to the supervisor."""
