"""Helpers of setup.py and bootstrap.py; not part of the installed package."""
