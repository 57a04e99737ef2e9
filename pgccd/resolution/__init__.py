"""Resolution of collisions: how far each body of a scene may move such that none meets another."""
