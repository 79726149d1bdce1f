/* Judges a buffer of host frames and keeps the state after each: what a compiled loop reaches.
 *
 * It stands on the header that `bilprov spec emit c` writes, and on the motions of the kit, which
 * are in motions.h. Frames of at most one data byte are looked up in a table that `judge` has
 * filled; the others are judged one by one. */
#include <stddef.h>
#include <stdint.h>

#define KEYS 65536 /* header byte and first data byte */

typedef union {
    struct {
        int16_t motion, speed, steering, led;
    } is;
    uint64_t packed;
} State;

#include "motions.h"
#include "protocol.h"

/* The response that a frame is due, and the state after it. */
static uint8_t judge(const uint8_t *frame, State *state)
{
    uint8_t length = (frame[0] & ROBOT_CAR_LENGTH_MASK) >> ROBOT_CAR_LENGTH_SHIFT;
    uint8_t right, code;
    const uint8_t *data = frame + 1;

    switch (frame[0]) {
    case ROBOT_CAR_STOP:
        state->is.motion = STOPPED;
        state->is.steering = 0;
        return ROBOT_CAR_ON_VALID;
    case ROBOT_CAR_SPEED:
        state->is.speed = data[ROBOT_CAR_SPEED_SPEED_OFFSET];
        return ROBOT_CAR_ON_VALID;
    case ROBOT_CAR_FORWARD:
        state->is.motion = FORWARD;
        return ROBOT_CAR_ON_VALID;
    case ROBOT_CAR_BACKWARD:
        state->is.motion = BACKWARD;
        return ROBOT_CAR_ON_VALID;
    case ROBOT_CAR_RIGHT:
        state->is.steering = data[ROBOT_CAR_RIGHT_STRENGTH_OFFSET];
        return ROBOT_CAR_ON_VALID;
    case ROBOT_CAR_LEFT:
        state->is.steering = -data[ROBOT_CAR_LEFT_STRENGTH_OFFSET];
        return ROBOT_CAR_ON_VALID;
    case ROBOT_CAR_ROTATE_RIGHT:
        state->is.motion = ROTATE_RIGHT;
        return ROBOT_CAR_ON_VALID;
    case ROBOT_CAR_ROTATE_LEFT:
        state->is.motion = ROTATE_LEFT;
        return ROBOT_CAR_ON_VALID;
    case ROBOT_CAR_LED:
        if (data[ROBOT_CAR_LED_RGB_OFFSET] <= ROBOT_CAR_LED_RGB_MAX) {
            state->is.led = data[ROBOT_CAR_LED_RGB_OFFSET];
            return ROBOT_CAR_ON_VALID;
        }
        code = ROBOT_CAR_ON_BAD_DATA;
        break;
    default:
        switch ((frame[0] & ROBOT_CAR_ID_MASK) >> ROBOT_CAR_ID_SHIFT) {
        case ROBOT_CAR_STOP_ID: right = ROBOT_CAR_STOP_LENGTH; break;
        case ROBOT_CAR_SPEED_ID: right = ROBOT_CAR_SPEED_LENGTH; break;
        case ROBOT_CAR_FORWARD_ID: right = ROBOT_CAR_FORWARD_LENGTH; break;
        case ROBOT_CAR_BACKWARD_ID: right = ROBOT_CAR_BACKWARD_LENGTH; break;
        case ROBOT_CAR_RIGHT_ID: right = ROBOT_CAR_RIGHT_LENGTH; break;
        case ROBOT_CAR_LEFT_ID: right = ROBOT_CAR_LEFT_LENGTH; break;
        case ROBOT_CAR_ROTATE_RIGHT_ID: right = ROBOT_CAR_ROTATE_RIGHT_LENGTH; break;
        case ROBOT_CAR_ROTATE_LEFT_ID: right = ROBOT_CAR_ROTATE_LEFT_LENGTH; break;
        case ROBOT_CAR_LED_ID: right = ROBOT_CAR_LED_LENGTH; break;
        default: right = length;
        }
        code = length > right   ? ROBOT_CAR_ON_TOO_MANY
               : length < right ? ROBOT_CAR_ON_TOO_FEW
                                : ROBOT_CAR_ON_UNKNOWN_ID;
    }
    state->is.motion = STOPPED;
    state->is.steering = 0;
    return code;
}

static struct {
    uint64_t kept, set; /* state after = state before & kept | set */
    uint8_t code;
} table[KEYS];
static uint8_t lengths[256];

void prepare(void)
{
    for (int header = 0; header < 256; header++)
        lengths[header] = (header & ROBOT_CAR_LENGTH_MASK) >> ROBOT_CAR_LENGTH_SHIFT;
    for (int key = 0; key < KEYS; key++) {
        uint8_t frame[ROBOT_CAR_MAX_FRAME] = {key >> 8, key & 0xff};
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
