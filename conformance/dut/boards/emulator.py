"""What every emulator may say instead of running."""


class EmulatorError(Exception):
    """An emulator that is missing, or firmware that it cannot run, in one sentence."""
