"""Bodies on ranks that do not own them: ghosts, and migration to a new owner."""
