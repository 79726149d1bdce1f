/* Bugs of the kind that firmware has, to be planted one at a time: -DBUG_STOP_KEEPS_PWM.
 *
 * They are for trying test equipment on. Each is 0 unless it is asked for, and then costs nothing.
 */
#ifndef BUGS_H
#define BUGS_H

/* -- interrupts, rings and clocks -- */

/* The silence is read while nothing is expected, and kept: as without `volatile`. */
#ifndef BUG_STALE_SILENCE
#define BUG_STALE_SILENCE 0
#endif
/* The reading index of a ring wraps to 1. */
#ifndef BUG_RING_WRAPS_TO_ONE
#define BUG_RING_WRAPS_TO_ONE 0
#endif
/* A byte that arrives while an answer is being sent is lost. */
#ifndef BUG_DEAF_WHILE_ANSWERING
#define BUG_DEAF_WHILE_ANSWERING 0
#endif
/* An answer is dropped while another is being sent. */
#ifndef BUG_ANSWER_LOST_WHEN_BUSY
#define BUG_ANSWER_LOST_WHEN_BUSY 0
#endif
/* The place that was sent is only left when the ring turns out to hold another answer. */
#ifndef BUG_ANSWER_TWICE_WHEN_QUEUED
#define BUG_ANSWER_TWICE_WHEN_QUEUED 0
#endif
/* The transmitter is switched on after the first answer was written. */
#ifndef BUG_FIRST_ANSWER_LOST
#define BUG_FIRST_ANSWER_LOST 0
#endif
/* The tick's interrupt is not enabled. */
#ifndef BUG_NO_TICK
#define BUG_NO_TICK 0
#endif
/* Deadlines are kept in one byte of milliseconds and compared with `>`. */
#ifndef BUG_CLOCK_WRAPS
#define BUG_CLOCK_WRAPS 0
#endif
/* Only bytes feed the watchdog, not the main loop. */
#ifndef BUG_WATCHDOG_STARVES
#define BUG_WATCHDOG_STARVES 0
#endif
/* The same, and what the robot knew is not reset by it. */
#ifndef BUG_STATE_KEPT_OVER_WATCHDOG
#define BUG_STATE_KEPT_OVER_WATCHDOG 0
#endif
/* The main loop hangs until the watchdog comes. */
#ifndef BUG_HANGS_AT_FULL_SPEED
#define BUG_HANGS_AT_FULL_SPEED 0
#endif

/* -- the frame -- */

/* The time-out is armed by a header and not disarmed by the frame's end. */
#ifndef BUG_TIMEOUT_LEFT_ARMED
#define BUG_TIMEOUT_LEFT_ARMED 0
#endif
/* The time-out answers, but forgets to stop. */
#ifndef BUG_TIMEOUT_DRIVES_ON
#define BUG_TIMEOUT_DRIVES_ON 0
#endif
/* The index of the data is not reset by a header. */
#ifndef BUG_STALE_DATA_INDEX
#define BUG_STALE_DATA_INDEX 0
#endif
/* Room for eight data bytes: the ninth lands on what stands behind them. */
#ifndef BUG_DATA_OVERRUN
#define BUG_DATA_OVERRUN 0
#endif
/* The number of data bytes is taken to have three bits. */
#ifndef BUG_LENGTH_OF_THREE_BITS
#define BUG_LENGTH_OF_THREE_BITS 0
#endif
/* The table of IDs is read one too far. */
#ifndef BUG_ONE_ID_TOO_MANY
#define BUG_ONE_ID_TOO_MANY 0
#endif
/* A second Stop in a row is taken for a line at rest and not answered. */
#ifndef BUG_SECOND_STOP_UNANSWERED
#define BUG_SECOND_STOP_UNANSWERED 0
#endif
/* A count of frames in one byte doubles as the flag that one is to be done. */
#ifndef BUG_FRAME_COUNT_WRAPS
#define BUG_FRAME_COUNT_WRAPS 0
#endif

/* -- what is done -- */

/* A stop clears the motion, but not the PWM. */
#ifndef BUG_STOP_KEEPS_PWM
#define BUG_STOP_KEEPS_PWM 0
#endif
/* A stop reaches the left motor only. */
#ifndef BUG_STOP_ONE_MOTOR
#define BUG_STOP_ONE_MOTOR 0
#endif
/* A fault stops the wheels, but leaves the motion: the next setting drives on. */
#ifndef BUG_STOP_LEAVES_MOTION
#define BUG_STOP_LEAVES_MOTION 0
#endif
/* A fault stops only once until the next Stop. */
#ifndef BUG_SAFE_LATCH
#define BUG_SAFE_LATCH 0
#endif
/* The wheels run down over a quarter of a second. */
#ifndef BUG_RUNS_DOWN
#define BUG_RUNS_DOWN 0
#endif
/* The speed is a signed byte. */
#ifndef BUG_SIGNED_SPEED
#define BUG_SIGNED_SPEED 0
#endif
/* Speed and steering are multiplied in 16 bits. */
#ifndef BUG_STEERING_OVERFLOWS
#define BUG_STEERING_OVERFLOWS 0
#endif
/* A `break` is missing: Right ends as Left. */
#ifndef BUG_RIGHT_FALLS_THROUGH
#define BUG_RIGHT_FALLS_THROUGH 0
#endif
/* The duty is counted from one: full speed wraps to none. */
#ifndef BUG_FULL_SPEED_WRAPS
#define BUG_FULL_SPEED_WRAPS 0
#endif
/* The right motor's backward pin is not set up. */
#ifndef BUG_BACKWARD_PIN_NO_OUTPUT
#define BUG_BACKWARD_PIN_NO_OUTPUT 0
#endif
/* The diode's upper bits are masked instead of refused. */
#ifndef BUG_LIGHT_MASKED
#define BUG_LIGHT_MASKED 0
#endif
/* The diode's range is checked on a signed byte. */
#ifndef BUG_LIGHT_CHECKED_SIGNED
#define BUG_LIGHT_CHECKED_SIGNED 0
#endif
/* The diode is lit before its range is checked. */
#ifndef BUG_LIGHT_BEFORE_CHECK
#define BUG_LIGHT_BEFORE_CHECK 0
#endif
/* The diode's plug is the wrong way round. */
#ifndef BUG_LIGHT_REVERSED
#define BUG_LIGHT_REVERSED 0
#endif
/* Lighting the diode writes a whole register that belongs to the right motor too. */
#ifndef BUG_LIGHT_STOPS_A_MOTOR
#define BUG_LIGHT_STOPS_A_MOTOR 0
#endif

#endif
