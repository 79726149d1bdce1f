"""`bilprov replay`: a capture shown as it was sniffed, and on demand sent to a device again."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack

import rich_click as click

from analyzer.capture_session import capture_line, capture_session, capture_timeout, said_about
from analyzer.cli_options import (
    compiled,
    filter_option,
    line_options,
    line_settings,
    note,
    opened_output,
    timeout_option,
)
from analyzer.comparison import Run, differences
from analyzer.confirm import confirm_motion
from analyzer.grammar_file import load_protocol
from analyzer.line_settings import LineSettings
from analyzer.outputs import Format, Output, Shown, chosen_format
from analyzer.pairing import MILLISECOND
from analyzer.pipeline import Pipeline
from analyzer.playing import Event, interruptible, played
from analyzer.ports import open_port
from analyzer.records import (
    DeviceRecord,
    Fault,
    FaultRecord,
    HostRecord,
    Record,
    Severity,
)
from analyzer.session import BOTH, Session
from analyzer.statistics import Statistics
from analyzer.stopping import Stopper
from analyzer.target import Target, scaled_timeout
from captures.errors import shown
from captures.reader import Capture, open_capture
from spec.protocol import Protocol
