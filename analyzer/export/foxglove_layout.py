"""Writes a layout for Foxglove: panels for what a capture of this protocol holds.

The car's speed and steering over time, its motion, the latency of its answers, the newest
instruction and answer, and everything odd as a log. Foxglove imports it as a layout file.
"""

from __future__ import annotations

from typing import Any

import msgspec

from bilprov.captures.schemas import Instruction, Log, Response, State
from bilprov.captures.topics import BY_VALUE
from bilprov.spec.protocol import Protocol

_INSTRUCTIONS, _RESPONSES, _STATE, _FAULTS = (
    BY_VALUE[value].name for value in (Instruction, Response, State, Log)
)
_INFO = 2  # Foxglove's level of a log message


def foxglove_layout(protocol: Protocol) -> bytes:
    """The layout as JSON; the axis of speed and steering is as long as the grammar allows."""
    title = f"{protocol.name} {protocol.version}"
    ends = [end for name in ("speed", "steering") for end in protocol.bounds.get(name, ())]
    low, high = min(ends, default=0), max(ends, default=1)
    panels: dict[str, dict[str, Any]] = {
        "Plot!drive": _plot(
            f"Speed and steering: {title}",
            [(f"{_STATE}.speed", "speed"), (f"{_STATE}.steering", "steering")],
            minYValue=low,
            maxYValue=high,
        ),
        "StateTransitions!motion": {
            "foxglovePanelTitle": "Motion",
            "paths": [
                _path(f"{_STATE}.motion", "motion"),
                _path(f"{_STATE}.moving", "moving"),
                _path(f"{_STATE}.led", "led"),
            ],
            "isSynced": True,
        },
        "Plot!latency": _plot(
            "Latency of the answers",
            [(f"{_RESPONSES}.latency_ns.@mul(0.000001)", "ms")],
        ),
        "RawMessages!instruction": _messages("Instruction", _INSTRUCTIONS),
        "RawMessages!response": _messages("Response", _RESPONSES),
        "RosOut!faults": {
            "foxglovePanelTitle": "Faults",
            "topicToRender": _FAULTS,
            "minLogLevel": _INFO,
            "searchTerms": [],
        },
    }
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _beside(
            _above("Plot!drive", _above("StateTransitions!motion", "Plot!latency", 50), 45),
            _above(_beside("RawMessages!instruction", "RawMessages!response", 50), "RosOut!faults"),
        ),
    }
    return msgspec.json.format(msgspec.json.encode(layout), indent=2) + b"\n"


def _path(value: str, label: str) -> dict[str, Any]:
    return {"value": value, "label": label, "enabled": True, "timestampMethod": "receiveTime"}


def _plot(title: str, paths: list[tuple[str, str]], **more: Any) -> dict[str, Any]:
    return {
        "foxglovePanelTitle": title,
        "paths": [_path(value, label) for value, label in paths],
        "xAxisVal": "timestamp",
        "isSynced": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showPlotValuesInLegend": True,
        **more,
    }


def _messages(title: str, topic: str) -> dict[str, Any]:
    return {
        "foxglovePanelTitle": title,
        "topicPath": topic,
        "diffEnabled": False,
        "diffMethod": "custom",
        "diffTopicPath": "",
        "showFullMessageForDiff": False,
    }


def _beside(first: Any, second: Any, percent: int = 60) -> dict[str, Any]:
    return _split("row", first, second, percent)


def _above(first: Any, second: Any, percent: int = 60) -> dict[str, Any]:
    return _split("column", first, second, percent)


def _split(direction: str, first: Any, second: Any, percent: int) -> dict[str, Any]:
    return {
        "direction": direction,
        "first": first,
        "second": second,
        "splitPercentage": percent,
    }
