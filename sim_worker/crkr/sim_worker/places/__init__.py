"""Where workers and runs are executed: on this machine, or on the nodes of a cluster."""
