/* The robot's controller. Every number of the protocol comes from the generated header. */
#include "robot.h"

#include "bugs.h"
#include "protocol.h"

#if BUG_STATE_KEPT_OVER_WATCHDOG
__attribute__((section(".noinit")))
#endif
volatile struct robot_state robot;

/* The frame that is being received. */
static struct {
    uint8_t missing; /* data bytes still to come */
    uint8_t count;   /* data bytes that came */
    uint8_t header;
    uint8_t answer; /* what it will be answered */
    uint8_t lost;   /* a byte of it is missing: what comes belongs to nothing until a pause */
    uint8_t data[ROBOT_CAR_MAX_DATA];
} frame;

static uint8_t armed, latched, frames; /* of planted bugs alone */

static int16_t steered(uint8_t speed, int16_t strength)
{
    /* The wheel on the inside is slowed in proportion; full steering stands it still. */
    if (BUG_STEERING_OVERFLOWS)
        return (int16_t)((int16_t)(speed * (ROBOT_CAR_RIGHT_STRENGTH_MAX - strength))
                         / ROBOT_CAR_RIGHT_STRENGTH_MAX);
    return (int16_t)((int32_t)speed * (ROBOT_CAR_RIGHT_STRENGTH_MAX - strength)
                     / ROBOT_CAR_RIGHT_STRENGTH_MAX);
}

/* Tell the wheels what the state says. */
static void drive(void)
{
    int16_t left = BUG_SIGNED_SPEED ? (int8_t)robot.speed : robot.speed, right = left;

    switch (robot.motion) {
    case ROBOT_FORWARD:
    case ROBOT_BACKWARD:
        if (robot.steering > 0)
            right = steered(robot.speed, robot.steering);
        else
            left = steered(robot.speed, (int16_t)-robot.steering);
        if (robot.motion == ROBOT_BACKWARD) {
            left = (int16_t)-left;
            right = (int16_t)-right;
        }
        break;
    case ROBOT_ROTATE_RIGHT:
        right = (int16_t)-right;
        break;
    case ROBOT_ROTATE_LEFT:
        left = (int16_t)-left;
        break;
    default:
        left = right = 0;
    }
    if (BUG_STOP_ONE_MOTOR && robot.motion == ROBOT_STOPPED)
        right = robot.right;
    robot.left = left;
    robot.right = right;
    board_drive(left, right);
}

static void move(uint8_t motion)
{
    robot.motion = motion;
    drive();
}

static void steer(int16_t strength)
{
    robot.steering = strength;
    drive();
}

static void stop(void)
{
    robot.steering = 0;
    if (BUG_STOP_KEEPS_PWM)
        robot.motion = ROBOT_STOPPED;
    else
        move(ROBOT_STOPPED);
}

/* Section 2: a faulty instruction stops the robot at once. */
static void stop_for_safety(void)
{
    if (BUG_SAFE_LATCH && latched)
        return;
    latched = 1;
    if (BUG_STOP_LEAVES_MOTION)
        board_drive(0, 0);
    else
        stop();
}

static void light(uint8_t rgb)
{
    robot.led = rgb;
    board_light(rgb);
}

/* The number of data bytes that an instruction has, or a negative number for an unused ID. */
static int8_t length_of(uint8_t id)
{
    switch (id) {
    case ROBOT_CAR_STOP_ID: return ROBOT_CAR_STOP_LENGTH;
    case ROBOT_CAR_SPEED_ID: return ROBOT_CAR_SPEED_LENGTH;
    case ROBOT_CAR_FORWARD_ID: return ROBOT_CAR_FORWARD_LENGTH;
    case ROBOT_CAR_BACKWARD_ID: return ROBOT_CAR_BACKWARD_LENGTH;
    case ROBOT_CAR_RIGHT_ID: return ROBOT_CAR_RIGHT_LENGTH;
    case ROBOT_CAR_LEFT_ID: return ROBOT_CAR_LEFT_LENGTH;
    case ROBOT_CAR_ROTATE_RIGHT_ID: return ROBOT_CAR_ROTATE_RIGHT_LENGTH;
    case ROBOT_CAR_ROTATE_LEFT_ID: return ROBOT_CAR_ROTATE_LEFT_LENGTH;
    case ROBOT_CAR_LED_ID: return ROBOT_CAR_LED_LENGTH;
    case ROBOT_CAR_LED_ID + 1: return BUG_ONE_ID_TOO_MANY ? ROBOT_CAR_LED_LENGTH : -1;
    default: return -1;
    }
}

/* Whether the diode can be lit so. */
static uint8_t is_light(uint8_t rgb)
{
    if (BUG_LIGHT_MASKED)
        return 1;
    if (BUG_LIGHT_CHECKED_SIGNED)
        return (int8_t)rgb <= ROBOT_CAR_LED_RGB_MAX;
    return rgb <= ROBOT_CAR_LED_RGB_MAX;
}

/* A whole frame with the right number of data bytes: do it, and tell what it is answered. */
static uint8_t execute(void)
{
    if (BUG_FRAME_COUNT_WRAPS && !++frames)
        return ROBOT_CAR_ON_VALID;
    switch (frame.header) {
    case ROBOT_CAR_STOP:
        latched = 0;
        stop();
        break;
    case ROBOT_CAR_SPEED:
        robot.speed = frame.data[ROBOT_CAR_SPEED_SPEED_OFFSET];
        while (BUG_HANGS_AT_FULL_SPEED && robot.speed == ROBOT_CAR_SPEED_SPEED_MAX)
            ;
        drive();
        break;
    case ROBOT_CAR_FORWARD:
        move(ROBOT_FORWARD);
        break;
    case ROBOT_CAR_BACKWARD:
        move(ROBOT_BACKWARD);
        break;
    case ROBOT_CAR_RIGHT:
        steer(frame.data[ROBOT_CAR_RIGHT_STRENGTH_OFFSET]);
        if (BUG_RIGHT_FALLS_THROUGH)
            steer((int16_t)-frame.data[ROBOT_CAR_RIGHT_STRENGTH_OFFSET]);
        break;
    case ROBOT_CAR_LEFT:
        steer((int16_t)-frame.data[ROBOT_CAR_LEFT_STRENGTH_OFFSET]);
        break;
    case ROBOT_CAR_ROTATE_RIGHT:
        move(ROBOT_ROTATE_RIGHT);
        break;
    case ROBOT_CAR_ROTATE_LEFT:
        move(ROBOT_ROTATE_LEFT);
        break;
    case ROBOT_CAR_LED:
        if (BUG_LIGHT_BEFORE_CHECK)
            light(frame.data[ROBOT_CAR_LED_RGB_OFFSET]);
        if (!is_light(frame.data[ROBOT_CAR_LED_RGB_OFFSET])) {
            stop_for_safety();
            return ROBOT_CAR_ON_BAD_DATA;
        }
        light(frame.data[ROBOT_CAR_LED_RGB_OFFSET]);
        break;
    }
    return ROBOT_CAR_ON_VALID;
}

/* Judge a header: the robot stops here already if nothing good can come of it. */
static void begin(uint8_t header)
{
    uint8_t announced = (header & ROBOT_CAR_LENGTH_MASK) >> ROBOT_CAR_LENGTH_SHIFT;
    int8_t length = length_of((uint8_t)((header & ROBOT_CAR_ID_MASK) >> ROBOT_CAR_ID_SHIFT));

    if (BUG_LENGTH_OF_THREE_BITS)
        announced &= ROBOT_CAR_LENGTH_MASK >> 1;
    frame.header = header;
    frame.missing = announced;
    if (!BUG_STALE_DATA_INDEX)
        frame.count = 0;
    if (length < 0)
        frame.answer = ROBOT_CAR_ON_UNKNOWN_ID;
    else if (announced > length)
        frame.answer = ROBOT_CAR_ON_TOO_MANY;
    else if (announced < length)
        frame.answer = ROBOT_CAR_ON_TOO_FEW;
    else
        frame.answer = ROBOT_CAR_ON_VALID;
    if (frame.answer != ROBOT_CAR_ON_VALID)
        stop_for_safety();
}

/* The frame is over: do what it says, and answer. */
static void end(void)
{
    uint8_t last = robot.last;

    robot.last = frame.header;
    if (BUG_SECOND_STOP_UNANSWERED && frame.header == ROBOT_CAR_STOP && last == frame.header)
        return;
    board_answer(frame.answer == ROBOT_CAR_ON_VALID ? execute() : frame.answer);
}

void robot_receive(uint8_t byte)
{
    if (frame.lost)
        return;
    if (frame.missing) {
        if (BUG_DATA_OVERRUN && frame.count >= 8)
            frame.answer = byte;
        frame.data[frame.count++ % ROBOT_CAR_MAX_DATA] = byte;
        frame.missing--;
    } else {
        begin(byte);
        armed = frame.missing != 0;
    }
    if (!frame.missing)
        end();
}

void robot_lost_byte(void)
{
    frame.lost = 1;
    stop_for_safety();
}

uint8_t robot_expects_pause(void)
{
    return frame.missing || frame.lost || (BUG_TIMEOUT_LEFT_ARMED && armed);
}

void robot_timed_out(void)
{
    uint8_t noise = frame.lost && !frame.missing; /* perhaps a header, and perhaps nothing */

    armed = 0;
    frame.missing = frame.lost = 0;
    if (!BUG_TIMEOUT_DRIVES_ON)
        stop_for_safety();
    if (noise)
        return;
    board_answer(frame.answer == ROBOT_CAR_ON_UNKNOWN_ID ? frame.answer : ROBOT_CAR_ON_TOO_FEW);
}

void robot_reset(void)
{
    frame.missing = frame.lost = 0;
    if (BUG_STATE_KEPT_OVER_WATCHDOG && robot.magic == ROBOT_MAGIC)
        return;
    robot.magic = ROBOT_MAGIC;
    robot.speed = 0;
    light(0);
    stop();
}
