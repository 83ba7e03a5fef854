"""Judging a policy: contexts, epochs, assessments and the history of a run."""
