"""Files written whole: what was there stays until the new content is complete."""

from __future__ import annotations

import os
import stat
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest

from bilprov.analyzer.files import from_toml, read_bounded, read_text, whole_file, write_whole


@pytest.mark.parametrize("interrupted", [False, True])
def test_the_old_content_stays_until_the_new_is_whole(tmp_path: Path, interrupted: bool) -> None:
    file = tmp_path / "a"
    file.write_bytes(b"old")
    with suppress(KeyboardInterrupt), whole_file(file) as out:
        out.write(b"new")
        assert file.read_bytes() == b"old"
        if interrupted:
            raise KeyboardInterrupt

    assert file.read_bytes() == (b"old" if interrupted else b"new")
    assert list(tmp_path.iterdir()) == [file]


def test_a_file_that_may_not_be_replaced_is_refused_before_anything_is_written(
    tmp_path: Path,
) -> None:
    file = tmp_path / "a"
    file.write_bytes(b"old")
    begun = False
    with pytest.raises(FileExistsError), whole_file(file, replace=False):
        begun = True

    assert not begun
    assert file.read_bytes() == b"old"


def test_a_file_that_appears_in_the_meantime_is_not_replaced(tmp_path: Path) -> None:
    file = tmp_path / "a"

    def overtaken() -> None:
        with whole_file(file, replace=False) as out:
            out.write(b"ours")
            file.write_bytes(b"theirs")

    with pytest.raises(FileExistsError):
        overtaken()
    assert file.read_bytes() == b"theirs"
    assert list(tmp_path.iterdir()) == [file]


def test_a_file_that_is_replaced_keeps_its_mode_and_a_link_its_target(tmp_path: Path) -> None:
    file, link = tmp_path / "a", tmp_path / "link"
    file.write_bytes(b"old")
    file.chmod(0o640)
    link.symlink_to(file)

    write_whole(link, b"new")

    assert link.is_symlink()
    assert (file.read_bytes(), file.stat().st_mode & 0o777) == (b"new", 0o640)


def test_a_pipe_is_written_to_as_it_is(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    with whole_file(pipe, replace=False) as out:
        out.write(b"through")
    reader.join()

    assert read == [b"through"]


def test_the_content_is_on_the_disk_before_its_name_and_then_the_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    sync, rename = os.fsync, Path.replace

    def synced(descriptor: int) -> None:
        kind = "folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file"
        done.append(kind)
        sync(descriptor)

    def renamed(part: Path, file: Path) -> Path:
        done.append("rename")
        return rename(part, file)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(Path, "replace", renamed)

    write_whole(tmp_path / "a", b"new")

    assert done == ["file", "rename", "folder"]


# -- pipes -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0, 5, 300_000])
def test_what_comes_through_a_pipe_is_read_up_to_a_bound(tmp_path: Path, size: int) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with ThreadPoolExecutor() as pool:
        writing = pool.submit(write_whole, pipe, b"x" * size)
        assert read_bounded(pipe, 400_000, pipes=True) == b"x" * size
        writing.result(60)
        if size > 10:
            writing = pool.submit(write_whole, pipe, b"x" * size)
            with pytest.raises(OSError, match="larger than"):
                read_bounded(pipe, 10, pipes=True)
            assert isinstance(writing.exception(60), BrokenPipeError)


def test_what_is_not_utf_8_is_refused_in_the_kits_words(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.write_bytes(b"baud = \xff")
    with pytest.raises(OSError, match="it is not UTF-8 text"):
        read_text(file, 100)


def test_a_number_of_too_many_digits_is_refused_in_the_kits_words() -> None:
    with pytest.raises(ValueError, match="one of its numbers has too many digits"):
        from_toml(f"a = {'9' * 5000}")


def test_texts_that_stand_for_typed_ones_keep_each_character() -> None:
    assert from_toml('a = ["x\\u200b\\n"]', typed=True) == {"a": ["x\u200b\n"]}
