"""Helpers shared by the tests: random shapes and motions, and comparison with the oracle."""
