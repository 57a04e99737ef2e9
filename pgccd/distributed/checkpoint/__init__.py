"""Checkpoints written by many ranks and read by any number of ranks, in the files of `pgccd.checkpoint`."""
