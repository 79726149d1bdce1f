"""Bounds what reads foreign bytes: CPU time, memory, and how it may fail."""

from __future__ import annotations

import resource
import signal
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import FrameType
from typing import NamedTuple, TypeVar

CPU_SECONDS = 5.0  # for one input
MEMORY = 1 << 30  # bytes of address space for all inputs, above what is in use before
_SOURCES = ("/spec/", "/captures/", "/analyzer/", "/conformance/")

Outcome = TypeVar("Outcome")


class Wrong(Exception):
    """Raised for a wrong result: two ways that must agree differ, or a broken file."""


def require(fine: bool, what: str) -> None:
    """Raise Wrong unless the result is fine."""
    if not fine:
        raise Wrong(what)


class Endless(BaseException):
    """Raised inside of what computes for too long; no `except Exception` sees it."""


class Failed(NamedTuple):
    """An exception that may not come, and the last place in the product that it passed."""

    error: str
    where: str

    def __str__(self) -> str:
        return f"{self.error} at {self.where}"


@cache
def _kept() -> tempfile.TemporaryDirectory[str]:
    memory = Path("/dev/shm")  # what is written is also synced to its disk
    parent = memory if memory.is_dir() else None
    return tempfile.TemporaryDirectory(prefix="bilprov-torture-", dir=parent)


def folder() -> Path:
    """A folder for the files of this process, which is removed with it."""
    return Path(_kept().name)


def guarded(act: Callable[[], Outcome]) -> Outcome | Failed:
    """What an act returns, or how it failed; only within `watched` is it bounded."""
    signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
    try:
        return act()
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return _failed(error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _failed(error: BaseException) -> Failed:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if any(part in frame.filename for part in _SOURCES)]
    # These may end anywhere.
    place = 0 if isinstance(error, Endless | RecursionError | MemoryError) else -1
    found = (ours or frames)[place]
    said = f": {str(error)[:200]}" if str(error) else ""
    return Failed(f"{type(error).__name__}{said}", f"{Path(found.filename).name}:{found.lineno}")


@contextmanager
def watched() -> Iterator[None]:
    """Bound computing and memory meanwhile; a warning is an error."""

    def over(number: int, frame: FrameType | None) -> None:
        raise Endless(f"more than {CPU_SECONDS:g} s of computing")

    before = signal.signal(signal.SIGPROF, over)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = _address_space() + MEMORY
    if hard == resource.RLIM_INFINITY or most < hard:
        resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _address_space() -> int:
    """How many bytes of address space this process has."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()
