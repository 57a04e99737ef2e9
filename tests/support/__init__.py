"""Helpers shared by the tests: shapes and motions at random, and the comparisons with the oracle."""
