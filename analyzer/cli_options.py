"""The old name of `analyzer.options`, until nobody imports it."""

from analyzer.options import line_options, line_settings, note, timeout_in_ns

__all__ = ["line_options", "line_settings", "note", "timeout_in_ns"]
