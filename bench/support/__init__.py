"""Shared parts of the benchmark scripts: timing, results, peers, scenes."""
