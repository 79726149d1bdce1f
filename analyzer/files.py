"""Writes files atomically: a reader finds the complete file, the old one, or none."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import tempfile
from contextlib import suppress
from pathlib import Path


def write_whole(file: Path, data: bytes) -> None:
    """Write a file atomically: to a temporary file beside it, which then replaces it.

    So no reader ever finds a half-written file. A pipe or a terminal is written to directly.
    Raises OSError.
    """
    file = file.resolve()
    if file.exists() and not file.is_file():
        file.write_bytes(data)
        return
    part = file.with_name(f".{file.name[:200]}.{os.getpid()}.part")
    try:
        part.write_bytes(data)
        if file.exists():
            shutil.copymode(file, part)
        part.replace(file)
    except BaseException:
        with suppress(OSError):
            part.unlink()
        raise


def replace_file(path: Path, data: bytes) -> None:
    """Replace a file atomically and sync it, so that a crash leaves the old or the new content.

    Raises OSError.
    """
    target = path.resolve()
    mode = stat.S_IMODE(target.stat().st_mode) if target.exists() else None
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
    beside = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if mode is None:
            umask = os.umask(0)
            os.umask(umask)
            mode = 0o666 & ~umask
        beside.chmod(mode)
        beside.replace(target)
    except BaseException:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise
