"""From processes started by a launcher to a `Comm`: placement, rendezvous and agreement."""
