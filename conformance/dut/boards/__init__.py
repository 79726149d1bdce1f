"""Emulated boards: real firmware under an emulator as the device under test."""

from bilprov.spec.errors import UserError


class EmulatorError(UserError):
    """The emulator is missing or cannot run the firmware; the message says so in one sentence."""
