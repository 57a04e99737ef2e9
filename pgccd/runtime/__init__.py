"""Utilities around torch and CUDA: capacities of buffers, events, copies to the host, stage times,
graphs.
"""
