"""Checkpoints: columns in safetensors files, everything else in JSON. Their content is never executed or unpickled.

    checkpoints/newest.json                      names the newest complete one, and the hash of its index; replaced last
    checkpoints/step-000000020-1f0c9a27/
        index.json                               kind and header; types of the columns; size and hash of each file
        rank-00000.safetensors, ...              tables of rows, one file per writing rank
        shared.safetensors                       tensors that are equal on all ranks
        newest.json                              makes this the newest one, if it is copied to `checkpoints`

Every checkpoint is a new folder. Its files are synced to disk and seen by rank 0 before the index is written, and the
index before `newest.json`; earlier checkpoints are removed last, except the newest of them. There is a complete
checkpoint at any time after the first one. Files are regular and of a sane size, and their hashes are checked, before
they are read: a modified, truncated or exchanged file raises an error.

Simulations and `pgccd.distributed.World` write checkpoints, on one rank or many; any number of ranks can read them.
"""
