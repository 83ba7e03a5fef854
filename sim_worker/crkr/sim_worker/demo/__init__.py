"""All of crkr on one machine: server, workers and dashboard as real processes, followed through the log."""
