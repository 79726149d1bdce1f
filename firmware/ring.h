/* A ring of bytes between an interrupt and the main loop: one writes, the other reads.
 *
 * Each index is one byte, which an 8-bit machine reads and writes in one go; so no interrupt has to
 * be held off. One place stays empty, which tells full from empty.
 */
#ifndef RING_H
#define RING_H

#include <stdint.h>

#include "bugs.h"

#define RING_SIZE 128u /* a power of two, so that indices wrap by themselves */

struct ring {
    volatile uint8_t in, out;
    volatile uint8_t bytes[RING_SIZE];
};

static inline uint8_t ring_next(uint8_t index)
{
    return (uint8_t)((index + 1u) & (RING_SIZE - 1u));
}

static inline uint8_t ring_empty(const struct ring *ring)
{
    return ring->in == ring->out;
}

/* Put a byte in; 0 if there is no room. */
static inline uint8_t ring_put(struct ring *ring, uint8_t byte)
{
    uint8_t next = ring_next(ring->in);

    if (next == ring->out)
        return 0;
    ring->bytes[ring->in] = byte;
    ring->in = next;
    return 1;
}

/* Take the oldest byte out of a ring that is not empty. */
static inline uint8_t ring_take(struct ring *ring)
{
    uint8_t byte = ring->bytes[ring->out];

    ring->out = ring_next(ring->out);
    if (BUG_RING_WRAPS_TO_ONE && !ring->out && ring->in)
        ring->out = 1;
    return byte;
}

#endif
