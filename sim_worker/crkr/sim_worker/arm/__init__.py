"""The six-joint arm that the shipped skills share: kinematics, dynamics, collisions, control."""
