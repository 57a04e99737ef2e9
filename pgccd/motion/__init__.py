"""Motions of bodies in a step: rigid paths, vertex paths, trajectories."""
