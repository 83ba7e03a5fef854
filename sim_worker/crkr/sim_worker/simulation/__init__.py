"""MuJoCo for the shipped skills: scene files, whole motions in one call, and rendering."""
