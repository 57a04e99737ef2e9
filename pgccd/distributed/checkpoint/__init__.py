"""Checkpoints that many ranks write, and any number of ranks reads; their files are those of `pgccd.checkpoint`."""
