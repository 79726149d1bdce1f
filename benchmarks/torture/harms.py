"""The harms that there are, in the order in which docs/RELIABILITY.md has them."""

from __future__ import annotations

from benchmarks.torture import (
    chunks,
    damage,
    exits,
    floods,
    fuzzing,
    grammars,
    hostile,
    jitter,
    kills,
    matrices,
    noise,
    nonblocking,
    pauses,
    probes,
    seams,
    servers,
    unplugs,
)

HARMS = {
    harm.name: harm
    for harm in (
        damage.HARM,
        chunks.HARM,
        hostile.HARM,
        kills.HARM,
        unplugs.HARM,
        exits.HARM,
        exits.SIGNALS_HARM,
        floods.HARM,
        servers.HARM,
        grammars.HARM,
        noise.HARM,
        jitter.HARM,
        pauses.HARM,
        probes.HARM,
        nonblocking.HARM,
        seams.HARM,
        matrices.HARM,
        fuzzing.HARM,
    )
}
