"""One request and its answer as a procedure, for any layout of frames."""

from __future__ import annotations

from bilprov.analyzer.client.operations import Procedure, listen, send
from bilprov.spec.codec import Judgement
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import reply_size


def exchange(protocol: Protocol, asked: Judgement, patience: int, pause: int) -> Procedure[bytes]:
    """Send a request and return what is heard until its answer is whole; b"" if none is due.

    The first byte may take `patience` ns, each of the others `pause` ns.
    """
    yield from send(asked.frame)
    held = bytearray()
    while asked.answer_due:
        size = reply_size(protocol, bytes(held), asked) if held else None
        if size is not None and size <= len(held):
            break
        missing = size - len(held) if size else 1
        heard = yield from listen(missing, pause if held else patience)
        if not heard.answers:
            break
        held += bytes(heard.codes)
    return bytes(held)
