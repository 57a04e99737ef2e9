"""Contacts: their columns, and what they say afterwards: normals, approach, derivatives, groups."""
