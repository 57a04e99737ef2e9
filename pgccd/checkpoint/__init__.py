"""Checkpoints: columns in safetensors files, all else in JSON. Nothing in them is executed or unpickled.

    checkpoints/newest.json                      names the newest whole one, and the hash of its index; replaced last
    checkpoints/step-000000020-1f0c9a27/
        index.json                               what it is of; the types of its columns; size and hash of each file
        rank-00000.safetensors, ...              tables of rows, one file a rank that wrote
        shared.safetensors                       tensors that are the same on all ranks

Every checkpoint is a new folder. Its files are on the disk before the index, and that before `newest.json`; the one
named before is removed last. So there is a whole checkpoint at any moment after the first. What is read is first
compared with its hash: a file that was changed, cut off or exchanged is refused.

A simulation and a `pgccd.distributed.World` write them, on one rank or many; any number of ranks can read them.
"""
