"""A task's specification: its axes, its settings, and the checks on both."""
