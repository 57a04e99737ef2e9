"""Ownership of space by ranks, and load balancing."""
