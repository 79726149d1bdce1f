/* The robot's controller: frames in, answers and motions out. No register is met here.
 *
 * A board calls the functions of the first part and provides those of the second. All of them run
 * in the main loop, never in an interrupt.
 */
#ifndef ROBOT_H
#define ROBOT_H

#include <stdint.h>

enum robot_motion {
    ROBOT_STOPPED,
    ROBOT_FORWARD,
    ROBOT_BACKWARD,
    ROBOT_ROTATE_RIGHT,
    ROBOT_ROTATE_LEFT
};

/* What the robot does, where a debugger finds it: little-endian, without padding. */
#define ROBOT_MAGIC 0x42494c21u

struct robot_state {
    uint32_t magic;
    uint8_t motion; /* enum robot_motion, as it was told */
    uint8_t speed;
    int16_t steering; /* right positive */
    int16_t left;     /* what the wheels are told, forward positive */
    int16_t right;
    uint8_t led;
    uint8_t last; /* header of the last frame that was whole */
};

extern volatile struct robot_state robot;

/* -- the robot ------------------------------------------------------------------------------- */

/* After power-on, and after every other reset: at rest. */
void robot_reset(void);

/* The next byte from the host. */
void robot_receive(uint8_t byte);

/* A byte was damaged or lost, nobody knows which: what is received now is faulty.
 *
 * It stops at once, and what comes is thrown away until a pause: it may be data as well as headers.
 */
void robot_lost_byte(void);

/* Whether a frame has begun and lacks data, or a byte was lost: then a pause must end it. */
uint8_t robot_expects_pause(void);

/* The line was silent for the whole time-out although a pause was expected. */
void robot_timed_out(void);

/* -- the board ------------------------------------------------------------------------------- */

/* Drive the wheels from now on, each -255 to 255, forward positive. */
void board_drive(int16_t left, int16_t right);

/* Light the diode: the three bits of an LED instruction. */
void board_light(uint8_t rgb);

/* Send an answer. */
void board_answer(uint8_t code);

#endif
