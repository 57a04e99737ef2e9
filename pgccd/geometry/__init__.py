"""Meshes, scenes, and the files that meshes come from."""
