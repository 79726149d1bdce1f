"""A base class for objects that are closed at the end of their `with` block."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self


class Closing(ABC):
    """A context manager that calls `close` on every way out; `close` may be called repeatedly."""

    @abstractmethod
    def close(self) -> None:
        """Release the resources; further calls do nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
