"""Which panes a screen has room for, and how high they are: the frames go last."""

from __future__ import annotations

from typing import NamedTuple

SIDE_WIDTH = 30  # columns of the car and the figures, a space included
_BARS = 2  # lines above and below all panes
_LEAST_LIST = 4  # lines: title, heading, two rows
_FAULTS, _HEX, _TREE, _FIGURES, _CAR = 4, 3, 5, 9, 9  # lines that each pane needs, its title too
_BESIDE = 76  # columns from which on the bytes stand beside the fields
_HEX_WIDTHS = (28, 46)  # columns for three bytes with their bits, or five
_WIDE = 110  # columns beside which the bytes take more


class Arrangement(NamedTuple):
    """Lines of each pane with its title, 0 for one that is not shown.

    The list takes what is left. `beside` is the width of the bytes beside the fields, 0 where they
    stand below them. `side` tells whether there is a column for the car and the figures.
    """

    side: bool
    car: int
    figures: int
    faults: int
    tree: int
    hex: int
    beside: int


def arranged(width: int, height: int, more: int = 0, *, zoomed: bool = False) -> Arrangement:
    """Arrange the panes on a screen of so many columns and lines; the fields alone if `zoomed`.

    `more` lines are taken by a prompt. Where not all fit, these go, in this order: the car, the
    figures, the faults, the fields, the bytes.
    """
    body = max(0, height - _BARS - more)
    if zoomed:
        hex_lines = _HEX if body >= _TREE + _HEX else 0
        return Arrangement(False, 0, 0, 0, body - hex_lines, hex_lines, 0)
    left = body - _LEAST_LIST
    hex_lines = _HEX if left >= _HEX else 0
    tree = _TREE if left >= _HEX + _TREE else 0
    faults = _FAULTS if left >= _HEX + _TREE + _FAULTS else 0
    side = width >= SIDE_WIDTH + 46 and faults > 0
    car = _CAR if side and body >= _CAR + _FIGURES else 0
    spare = left - hex_lines - tree - faults
    if spare > 0 and tree:
        tree += min(spare // 3, 10)
        faults += min(spare // 10, 3) if faults else 0
        hex_lines += 2 if spare >= 12 else 0
    main = width - (SIDE_WIDTH if side else 0)
    beside = _HEX_WIDTHS[main >= _WIDE] if main >= _BESIDE and tree else 0
    if beside:
        tree += hex_lines
        hex_lines = tree
    return Arrangement(side, car, body - car if side else 0, faults, tree, hex_lines, beside)
