"""How much one thing in a capture may hold; checked before anything is allocated."""

from __future__ import annotations

CHUNK_BYTES = 16 * 1024 * 1024
"""One chunk, as stored and unpacked."""

MESSAGE_BYTES = 64 * 1024
"""The data of one message."""

STRING_BYTES = 64 * 1024
"""One string of a header, a channel or a metadata record."""

RECORD_BYTES = 16 * 1024 * 1024
"""A record that is neither a chunk nor a message and whose content is wanted."""

ATTACHMENT_BYTES = 64 * 1024 * 1024
"""One attachment whose content is wanted."""

CHANNELS = 64
"""Channels in one file."""

DAMAGE_NOTES = 20
"""Sentences about damage; what comes after them is counted."""

WINDOW_MESSAGES = 4096
"""Messages held back to put a foreign file into time order."""

WINDOW_BYTES = 16 * 1024 * 1024
"""Their bytes."""
