"""A user's scene, distributed over ranks."""
