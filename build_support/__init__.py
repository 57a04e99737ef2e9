"""Helpers of setup.py and bootstrap.py; no part of the installed package."""
