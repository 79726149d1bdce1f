"""The pane about the chosen row: its fields bit by bit, and all else that is known about it.

The meanings are those of `spec.explain`. The predicted state is here only where it is not drawn
beside it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import groupby
from typing import ClassVar, NamedTuple, Self

from rich.style import Style
from rich.text import Text
from textual.binding import Binding, BindingType
from textual.geometry import Region, Size
from textual.reactive import Reactive
from textual.widgets import Tree
from textual.widgets.tree import TreeNode

from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record, serious_faults
from bilprov.analyzer.screen.keys import FOLDED, ORDINARY, REFUSAL, UNFOLDED, Look, look_of
from bilprov.captures.text import escape_controls
from bilprov.spec.codec import spaced
from bilprov.spec.explain import BitGroup, explain, explain_reply
from bilprov.spec.protocol import Protocol

_LEAST_WIDTH = 24  # columns in which text is wrapped


class Detail(NamedTuple):
    """One line: a `label` and what it says; the lines `below` it fold away.

    `group` are the bits that it is about; `look` is another one than the ordinary where it is odd.
    """

    label: str
    text: str = ""
    group: BitGroup | None = None
    look: Look = ORDINARY
    below: tuple[Detail, ...] = ()


def details(protocol: Protocol, record: Record, *, state: bool) -> Iterator[Detail]:
    """The lines of a record, with the predicted `state` if asked."""
    look = look_of(record)
    for fault in serious_faults(record):
        yield Detail("fault", f"{fault.kind}: {fault.reason}", look=look)
    if isinstance(record, HostRecord | DeviceRecord) and record.uncertain:
        yield Detail("uncertain", record.faults[-1].reason)
    told = record.state.described if state else ""
    after = [Detail("state", told)] if told else []
    numbers: list[Detail] = []
    if isinstance(record, HostRecord):
        if record.judgement:
            yield from _host(protocol, record.data, look, after)
        numbers.append(Detail("last byte", f"{(record.end - record.t) / 1e6:.3f} ms later"))
        if record.sequence is not None:
            numbers.append(Detail("instruction", f"number {record.sequence}"))
    elif isinstance(record, DeviceRecord):
        yield from _device(protocol, record, look, after)
    else:
        yield from after
    yield Detail("time", f"{record.t / 1e9:.9f} s", below=tuple(numbers))


def _host(protocol: Protocol, data: bytes, look: Look, state: Iterable[Detail]) -> Iterator[Detail]:
    frame = explain(protocol, data).frames[0]
    yield from _bits(frame.groups, data, look)
    yield from state
    does = Detail("does", frame.action)
    sets = (Detail("sets", f"{variable} to {value}") for variable, value in frame.changes)
    yield Detail("answer", frame.answer, below=(does, *sets))
    if frame.nearest:
        words = f"{spaced(frame.nearest.frame)}  {frame.nearest.describe()}"
        yield Detail("meant", words, below=tuple(Detail("as", d) for d in frame.differences))
    readings = (Detail(reading.id, reading.default) for reading in frame.readings)
    errata = (Detail(erratum.id, erratum.correction) for erratum in frame.errata)
    yield Detail("document", frame.judgement.clause, below=(*readings, *errata))


def _device(
    protocol: Protocol, record: DeviceRecord, look: Look, state: Iterable[Detail]
) -> Iterator[Detail]:
    response = explain_reply(protocol, record.data, record.answered if record.reply else None)
    groups = response.groups
    if look is REFUSAL and response.response:
        name = response.response.name
        groups = tuple(one._replace(fault=one.fault or one.meaning == name) for one in groups)
    yield from _bits(groups, record.data, look)
    if all(fault.reason != response.meaning for fault in serious_faults(record)):
        yield Detail("means", response.meaning)
    yield from state
    if record.answered is not None:
        answered, odd = record.answered, ORDINARY if record.agrees else look
        number = Detail("instruction", f"number {record.instruction}")
        expected = Detail("expected", answered.response.name, look=odd)
        words = f"{spaced(answered.frame)}  {answered.describe()}"
        yield Detail("answers", words, below=(expected, number))
    if record.latency is not None:
        yield Detail("latency", f"{record.latency / 1e6:.3f} ms")
    yield Detail("document", protocol.clauses.responses)


def _bits(groups: Iterable[BitGroup], data: bytes, look: Look) -> Iterator[Detail]:
    """A line for each group of bits; one for a run of bytes of `data` that mean the same."""
    for (name, meaning, fault, whole_byte), alike in groupby(groups, _sort):
        run, shown = tuple(alike), look if fault else ORDINARY
        if meaning and whole_byte and len(run) > 1:
            told = spaced(data[run[0].byte : run[0].byte + len(run)])
            yield Detail(name, f"{told}  {meaning}", run[0]._replace(size=len(run)), shown)
            continue
        for group in run:
            text = f"{bit_picture(group)}  {group.value:>3}  {group.meaning}"
            yield Detail(name, text, group, shown)


def _sort(group: BitGroup) -> tuple[str, str, bool, bool]:
    """What neighbouring bytes have in common that are shown on one line."""
    return group.name, group.meaning, group.fault, group.size == 1 and len(group.bits) == 8


def bit_picture(group: BitGroup) -> str:
    """The bits of a group in their places, dots for the others: `.... 0001`."""
    width = 8 * group.size
    bits = "." * (width - 1 - group.high) + group.bits + "." * group.low
    return " ".join(bits[low : low + 4] for low in range(0, width, 4))


class FieldTree(Tree[Detail]):
    """The details of one record; what was folded stays so in the next one.

    `repeat` is the number typed before a key, None for none.
    """

    virtual_size = Reactive(Size(0, 0))
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("left", "fold(True)", show=False),
        Binding("right", "fold(False)", show=False),
        Binding("up", "move(-1)", show=False),
        Binding("down", "move(1)", show=False),
    ]

    def __init__(self, protocol: Protocol) -> None:
        super().__init__("", id="fields")
        self.ICON_NODE, self.ICON_NODE_EXPANDED = FOLDED, UNFOLDED
        self.show_root = self.show_guides = False
        self.guide_depth = 2
        self.repeat: int | None = None
        self._protocol = protocol
        self._folded: set[str] = set()
        self._shown: tuple[Detail, ...] = ()

    @property
    def bytes(self) -> range:
        """The bytes that the chosen line is about, while fields are looked at."""
        detail = self.cursor_node.data if self.has_focus and self.cursor_node else None
        group = detail.group if detail else None
        return range(group.byte, group.byte + group.size) if group else range(0)

    def show(self, record: Record | None, *, state: bool) -> None:
        """Show another record, with the predicted `state` if asked."""
        shown = tuple(details(self._protocol, record, state=state)) if record else ()
        if shown != self._shown:
            self._fill(shown)

    def render_label(self, node: TreeNode[Detail], base_style: Style, style: Style) -> Text:
        """A line, which keeps its colours while another pane has the focus."""
        return super().render_label(node, base_style, style if self.has_focus else Style())

    def refresh(self, *regions: Region, **options: bool) -> Self:
        """Draw it again, without a new layout of the whole screen: other lines change no size."""
        return super().refresh(*regions, **options | {"layout": False})

    def watch_virtual_size(self, before: Size, after: Size) -> None:
        """Draw the scroll bar again; a new layout is only where it comes or goes."""
        self._scroll_update(after)

    def on_resize(self) -> None:
        """Wrap long lines anew."""
        self._fill(self._shown)

    def action_move(self, lines: int) -> None:
        """Move the choice by some lines."""
        self.cursor_line += lines * (self.repeat or 1)
        self.scroll_to_line(self.cursor_line, animate=False)

    def action_fold(self, fold: bool) -> None:
        """Fold the lines below the chosen one, or those that it is among; or unfold them."""
        node = self.cursor_node
        if node and not node.allow_expand and node.parent is not self.root:
            node = node.parent
        if node and node.allow_expand:
            self.move_cursor(node)
            node.collapse() if fold else node.expand()

    def on_tree_node_collapsed(self, event: Tree.NodeCollapsed[Detail]) -> None:
        """Keep these lines folded in other records too."""
        if event.node.data:
            self._folded.add(event.node.data.label)

    def on_tree_node_expanded(self, event: Tree.NodeExpanded[Detail]) -> None:
        """Show these lines in other records too."""
        if event.node.data:
            self._folded.discard(event.node.data.label)

    def _fill(self, shown: tuple[Detail, ...]) -> None:
        self._shown = shown
        self.clear()
        self._add(self.root, shown)
        self.cursor_line = 0

    def _add(self, parent: TreeNode[Detail], shown: tuple[Detail, ...]) -> None:
        """Add lines below another one: more than one each where they are longer than the pane."""
        room = max((len(detail.label) for detail in shown), default=0)
        for detail in shown:
            style, sign = detail.look.style, "" if detail.below else f"{detail.look.sign} "
            label = f"{sign}{escape_controls(detail.label):<{room}}  "
            text = Text(escape_controls(detail.text), style)
            width = self.size.width - len(label) - 2 * (2 if parent is self.root else 3)
            first, *more = text.wrap(self.app.console, max(width, _LEAST_WIDTH)) or [text]
            node = parent.add(
                Text.assemble((label, style or "dim"), first),
                detail,
                expand=detail.label not in self._folded,
                allow_expand=bool(detail.below),
            )
            for line in more:
                parent.add_leaf(Text(" " * len(label)) + line, detail)
            self._add(node, detail.below)
