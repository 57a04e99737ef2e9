"""From a moving scene to its contacts: broad phase, traversal, narrow phase, and the pipeline of these stages."""
