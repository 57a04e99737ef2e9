"""Audits of rollouts: what happened between their frames. `pgccd.audit` is the function of `audit.py`."""
