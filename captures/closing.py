"""What is closed when its `with` block is left, whichever way."""

from __future__ import annotations

from types import TracebackType
from typing import Self


class Closing:
    """A base of everything whose way out is `close`, which may be called more than once."""

    def close(self) -> None:
        """Give up what is held."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
