"""From a moving scene to its contacts: broad phase, traversal, narrow phase, and what runs these stages."""
