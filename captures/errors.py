"""The error of capture files; its one sentence says what came, what was allowed, what to do."""

from __future__ import annotations

from bilprov.spec.errors import UserError


class CaptureError(UserError):
    """A capture file cannot be written or read. The message is one sentence for the user."""
