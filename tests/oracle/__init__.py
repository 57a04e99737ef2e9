"""Independent ground truth for the tests: exact rational arithmetic and rigorous intervals. Does not import pgccd.

`linear`: exact first touch on straight paths. `separation`: the same with a minimum separation, and closest approach.
`rigid`: rigorous decisions on rigid arcs. `broad`: exact pairs of moving spheres. `mesh`: edges, feature pairs, SBV.
`detect`: all contacts of two bodies by brute force. `intersection`: common points of triangles at rest. `distance`:
distances at one time. `adversarial`, `constructed`: queries. Beneath them: `polynomial`, `interval`, `search`,
`filters`. For millions of queries: `batch` over `batch_paths` decides nearly all of them rigorously, and leaves the
rest to the above; `families` and `arcs` generate queries.
"""
