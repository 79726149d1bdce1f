"""Limits for the parts of a capture, in bytes or counts; checked before memory is allocated."""

from __future__ import annotations

CHUNK_BYTES = 16 * 1024 * 1024
"""Bytes of one chunk, as stored and as unpacked."""

MESSAGE_BYTES = 64 * 1024
"""Bytes of data of one message."""

STRING_BYTES = 64 * 1024
"""Bytes of one string of a header, a channel or a metadata record."""

RECORD_BYTES = 16 * 1024 * 1024
"""Bytes of a record that is neither a chunk nor a message and whose content is read."""

ATTACHMENT_BYTES = 64 * 1024 * 1024
"""Bytes of one attachment whose content is read."""

CHANNELS = 64
"""Channels in one file."""

DAMAGE_NOTES = 20
"""Sentences about damage; further damaged places are only counted."""

WINDOW_MESSAGES = 4096
"""Messages held back to put a foreign file into time order."""

WINDOW_BYTES = 16 * 1024 * 1024
"""Bytes of the messages held back."""
