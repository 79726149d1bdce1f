/* The robot as a program: bytes from standard input, answers to standard output.
 *
 * With -v it tells on standard error what wheels and diode do. It ends with its input; what is
 * missing from a frame then comes no more, so that frame is answered at once.
 */
#include <errno.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "protocol.h"
#include "robot.h"

static int verbose;

static void give_up(const char *what)
{
    perror(what);
    exit(EXIT_FAILURE);
}

/* -- what the robot asks for ----------------------------------------------------------------- */

void board_answer(uint8_t code)
{
    while (write(STDOUT_FILENO, &code, 1) != 1)
        if (errno != EINTR)
            give_up("standard output");
}

void board_drive(int16_t left, int16_t right)
{
    if (verbose)
        fprintf(stderr, "left %d right %d\n", left, right);
}

void board_light(uint8_t rgb)
{
    if (verbose)
        fprintf(stderr, "light %d\n", rgb);
}

/* -- the line -------------------------------------------------------------------------------- */

/* Whether bytes, or their end, came before the pause was too long. */
static int is_heard(void)
{
    struct pollfd line = {.fd = STDIN_FILENO, .events = POLLIN};
    int ready, longest = robot_expects_pause() ? ROBOT_CAR_TRUNCATION_TIMEOUT_MS : -1;

    while ((ready = poll(&line, 1, longest)) < 0)
        if (errno != EINTR)
            give_up("standard input");
    return ready;
}

/* Bytes that came, at least one; 0 at their end. */
static size_t heard(uint8_t *bytes, size_t room)
{
    ssize_t count;

    while ((count = read(STDIN_FILENO, bytes, room)) < 0)
        if (errno != EINTR)
            give_up("standard input");
    return (size_t)count;
}

int main(int argc, char **argv)
{
    uint8_t bytes[256];
    size_t count = 1;

    verbose = argc == 2 && !strcmp(argv[1], "-v");
    if (argc > 1 && !verbose) {
        fprintf(stderr, "usage: %s [-v] (bytes in, answers out; -v: what it does)\n", argv[0]);
        return 2;
    }
    robot_reset();
    while (count) {
        if (is_heard()) {
            count = heard(bytes, sizeof bytes);
            for (size_t i = 0; i < count; i++)
                robot_receive(bytes[i]);
        } else {
            robot_timed_out();
        }
    }
    if (robot_expects_pause())
        robot_timed_out();
    return EXIT_SUCCESS;
}
