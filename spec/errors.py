"""The base class of errors whose text is one sentence for the user."""

from __future__ import annotations


class UserError(Exception):
    """Wrong input, or something unusable; the text says what came, what is allowed, what to do."""
