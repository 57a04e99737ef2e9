"""Which rank owns which part of space, and how it changes as loads do."""
