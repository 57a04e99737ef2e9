"""Utilities around torch and CUDA: events, copies to the host, stage times, graphs."""
