"""From a distribution over goals to the goal to execute, with or without measured outcomes."""
