"""From processes that a launcher started to a `Comm`: who there is, where the store is, and whether all agree."""
