"""Where bodies go in a step: rigid paths, paths of vertices, trajectories."""
