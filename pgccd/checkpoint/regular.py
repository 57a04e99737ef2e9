"""Reads only files that are regular and of a sane size: a pipe would wait for a writer, and a file with holes may be
larger than the memory.
"""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path


@contextmanager
def open_regular(path: Path, most_bytes: int | None = None, follows_links: bool = True) -> Iterator[BufferedReader]:
    """A file opened for reading.

    Args:
        path: of the file.
        most_bytes: its largest size; default: any.
        follows_links: whether it may be a symbolic link.

    Raises:
        OSError: it cannot be opened, is no regular file, or is too large.
    """
    more = 0 if follows_links else os.O_NOFOLLOW
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | more)
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "it is no regular file")
        if most_bytes is not None and status.st_size > most_bytes:
            raise OSError(errno.EFBIG, f"it has {status.st_size} bytes, more than {most_bytes}")
    except OSError:
        os.close(descriptor)
        raise
    with os.fdopen(descriptor, "rb") as file:
        yield file


def read_regular(path: Path, most_bytes: int, follows_links: bool = True) -> bytes:
    """The content of a file; arguments and errors as for `open_regular`."""
    with open_regular(path, most_bytes, follows_links) as file:
        content = file.read(most_bytes + 1)  # it may grow meanwhile
    if len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"it has more than {most_bytes} bytes")
    return content
