"""Reads files up to a bound, and writes them atomically: complete, or not at all.

Foreign JSON and TOML become safe values, so that nothing behind this distrusts what it gets.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import msgspec

from bilprov.captures.text import escape_controls


def read_bounded(path: Path, most: int, *, pipes: bool = False) -> bytes:
    """The content of a regular file (or, with `pipes`, of a pipe) of at most `most` bytes.

    Raises OSError, whose `strerror` says why, for any other.
    """
    try:
        if path.exists() and not (path.is_file() or (pipes and path.is_fifo())):
            raise OSError(errno.EINVAL, "it is not a regular file")
        with path.open("rb") as file:
            data = file.read(most + 1)
    except ValueError as error:
        raise OSError(errno.EINVAL, "no file can have this name") from error
    if len(data) > most:
        raise OSError(errno.EFBIG, f"it is larger than {most >> 20} MiB")
    return data


def read_text(path: Path, most: int, *, pipes: bool = False) -> str:
    """The text of a file that `read_bounded` reads. Raises OSError as it does, and for no UTF-8."""
    try:
        return read_bounded(path, most, pipes=pipes).decode()
    except UnicodeDecodeError as error:
        raise OSError(errno.EILSEQ, "it is not UTF-8 text") from error


def real_path(path: str | Path) -> Path:
    """A path with its links followed; one in a ring of links stays (`Path.resolve` raises)."""
    return Path(os.path.realpath(path))


PLANTED = "another user made this link, in a folder that everybody may write to"


def _is_planted(file: Path) -> bool:
    """Whether a file is a link that another user made in a folder like /tmp.

    Whoever wrote through it would overwrite a file of his own that the other one chose. The kernel
    refuses to open such a link (`fs.protected_symlinks`); a file that is renamed is not opened.
    """
    try:
        link, folder = file.lstat(), file.absolute().parent.stat()
    except OSError:  # there is none
        return False
    shared = stat.S_ISVTX | stat.S_IWOTH
    return (
        stat.S_ISLNK(link.st_mode)
        and folder.st_mode & shared == shared
        and link.st_uid not in (os.geteuid(), folder.st_uid)
    )


def _target(file: Path) -> Path:
    """The file that is written where this one is named. Raises OSError for a planted link."""
    if _is_planted(file):
        raise OSError(errno.EACCES, PLANTED, str(file))
    return real_path(file)


def why_not_writable(file: Path) -> str:
    """Why a file cannot be written and what to do instead, "" if it can."""
    if file.is_dir():
        return "it is a folder; name a file"
    if not file.absolute().parent.is_dir():
        return "name a file in a folder that exists"
    if _is_planted(file):
        return f"{PLANTED}; name another file"
    allowed = not file.exists() or os.access(file, os.W_OK)
    if not file.exists() or file.is_file():  # anything else, as a pipe, is written as it is
        allowed = allowed and os.access(real_path(file).parent, os.W_OK | os.X_OK)
    return "" if allowed else "this user may not; name another file"


def write_whole(file: Path, data: bytes) -> None:
    """Write a file atomically, as `whole_file` does. Raises OSError."""
    with whole_file(file) as out:
        out.write(data)


@contextmanager
def whole_file(file: Path, *, replace: bool = True) -> Iterator[BinaryIO]:
    """Write a file atomically: a temporary file beside it, synced, renamed, its folder synced.

    So a reader, or a crash, finds the old content or the new one, never a half; where the block
    raises, the temporary file goes. It is always a new one: nobody can plant a link under its name.
    A pipe or a terminal is written to directly. Raises OSError, and FileExistsError where there is
    a file, now or at the end, which `replace` does not allow to be replaced.
    """
    file = _target(file)
    if file.exists() and not file.is_file():
        with file.open("wb") as pipe:
            yield pipe
        return
    if not replace and file.exists():  # before all the work
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(file))
    with replaced_whole(file, force=replace) as part, part.open("xb") as beside:
        yield beside


@contextmanager
def replaced_whole(file: Path, *, force: bool) -> Iterator[Path]:
    """Give a name beside `file` to write to; at the end of the block that becomes the file.

    If the block raises, what was written is removed. Raises FileExistsError, and keeps the old
    file, if there is one by then, unless `force`.
    """
    file = _target(file)
    part = file.with_name(f".{file.name[:200]}.{os.urandom(8).hex()}.part")
    try:
        yield part
        with part.open("rb") as written:
            os.fsync(written.fileno())
        if force:
            if file.exists():
                part.chmod(stat.S_IMODE(file.stat().st_mode))
            part.replace(file)
        else:
            _name_anew(part, file)
        with suppress(OSError):  # its name too, where the file system can do that
            folder = os.open(file.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
    finally:
        with suppress(OSError):
            part.unlink()


def _name_anew(part: Path, file: Path) -> None:
    """Give a file a second name. Raises FileExistsError where another one has it."""
    try:
        os.link(part, file)
    except FileExistsError:
        raise
    except OSError:  # the file system knows no links
        if file.exists():
            raise FileExistsError(errno.EEXIST, "it exists", str(file)) from None
        part.rename(file)


LONGEST_TEXT = 1 << 18
"""Characters of one text; the bytes of the largest read of a port as hex are fewer."""
LARGEST_NUMBER = 1 << 63
DEEPEST = 50
"""How many values may lie within each other."""
_DEEP = "too many of its values lie within each other"

Value = TypeVar("Value")


def safe(value: Any, room: int = DEEPEST, *, typed: bool = False) -> Any:
    """The same value of dicts, lists and tuples in which every text prints and has a bound.

    What does not print in a text, or a key, becomes an escape like `\\x1b`; a text beyond
    LONGEST_TEXT is cut, a whole number beyond LARGEST_NUMBER becomes that. With `typed` texts stay
    as they are, like what is typed on a command line. Raises ValueError for more values within each
    other than there is `room` for.
    """
    if not room:
        raise ValueError(_DEEP)
    if isinstance(value, str) and not typed:
        return escape_controls(value[:LONGEST_TEXT])[:LONGEST_TEXT]
    if isinstance(value, dict):
        pairs = value.items()
        return {safe(key, typed=typed): safe(inner, room - 1, typed=typed) for key, inner in pairs}
    if isinstance(value, list | tuple):
        return type(value)(safe(inner, room - 1, typed=typed) for inner in value)
    if type(value) is int:
        return max(-LARGEST_NUMBER, min(value, LARGEST_NUMBER))
    return value


def from_json(data: bytes, kind: type[Value]) -> Value:
    """The value of this type that JSON holds, made safe. Raises ValueError, in one sentence."""
    try:
        return msgspec.convert(safe(msgspec.json.decode(data)), kind)
    except RecursionError as error:
        raise ValueError(_DEEP) from error


def from_toml(text: str, *, typed: bool = False) -> dict[str, Any]:
    """The table that TOML holds, made `safe`. Raises ValueError, in one sentence."""
    import tomllib

    try:
        table = tomllib.loads(text)
    except RecursionError as error:
        raise ValueError(_DEEP) from error
    except tomllib.TOMLDecodeError:
        raise
    except ValueError as error:
        raise ValueError("one of its numbers has too many digits") from error
    found: dict[str, Any] = safe(table, typed=typed)
    return found
