"""Meshes, scenes, and mesh files."""
