"""Loops of steps on many ranks: what a rank keeps from step to step, and steps as replays of graphs."""
