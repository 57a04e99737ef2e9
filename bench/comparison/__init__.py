"""Comparison of pgccd with other programs: one module per question, each with a function that measures all programs on
one scene.
"""
