/* Judges a buffer of host frames and keeps the state after each: what a compiled loop reaches.
 *
 * judge.h is generated from the grammar, on the header that `bilprov spec emit c` writes. It has
 * `length_of`, `judge` and `power_on_state`. Frames of at most one data byte are looked up in a table
 * that `judge` has filled; the others are judged one by one. */
#include <stddef.h>
#include <stdint.h>

#define KEYS 65536 /* header byte and first data byte */

typedef union {
    struct {
        int16_t motion, speed, steering, led;
    } is;
    uint64_t packed;
} State;

#include "judge.h"

static struct {
    uint64_t kept, set; /* state after = state before & kept | set */
    uint8_t code;
} table[KEYS];
static uint8_t lengths[256];

void prepare(void)
{
    for (int header = 0; header < 256; header++)
        lengths[header] = length_of(header);
    for (int key = 0; key < KEYS; key++) {
        uint8_t frame[FRAME_MOST] = {key >> 8, key & 0xff};
        State zeros = {.packed = 0}, ones = {.packed = ~0ull};
        table[key].code = judge(frame, &zeros);
        judge(frame, &ones);
        table[key].set = zeros.packed & ones.packed;
        table[key].kept = zeros.packed ^ ones.packed;
    }
}

/* Judges the whole frames of `data` from the state in `*state` on. Returns their number, and
 * leaves the response code of each, the state after it, the last state and how many bytes the
 * frames have. */
size_t decode(const uint8_t *data, size_t size, uint8_t *codes, uint64_t *states, uint64_t *state,
              size_t *used)
{
    State now = {.packed = *state};
    size_t at = 0, frames = 0;
    while (at < size) {
        const uint8_t *frame = data + at;
        size_t length = lengths[frame[0]];
        if (length >= size - at)
            break;
        if (length < 2) {
            unsigned key = frame[0] << 8 | (length ? frame[1] : 0);
            now.packed = (now.packed & table[key].kept) | table[key].set;
            codes[frames] = table[key].code;
        } else {
            codes[frames] = judge(frame, &now);
        }
        states[frames++] = now.packed;
        at += 1 + length;
    }
    *state = now.packed;
    *used = at;
    return frames;
}

uint64_t power_on(void)
{
    State first = {.packed = 0};
    power_on_state(&first);
    return first.packed;
}
