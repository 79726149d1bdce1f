/* ATmega328P at 16 MHz, as on an Arduino Uno.
 *
 * D0, D1    serial line, by interrupts and rings
 * D6, D5    PWM of the left and the right motor (timer 0, 977 Hz)
 * D7, D8    direction of the left motor
 * D9, D10   direction of the right motor
 * A2 A1 A0  the diode's R, G and B
 * timer 1   a tick each millisecond: the pause inside a frame
 * watchdog  resets a main loop that hangs
 */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <util/atomic.h>

#include "bugs.h"
#include "protocol.h"
#include "ring.h"
#include "robot.h"

#ifndef F_CPU
#define F_CPU 16000000ul
#endif

#define LEFT_PWM _BV(PD6)
#define RIGHT_PWM _BV(PD5)
#define LEFT_FORWARD _BV(PD7)
#define LEFT_BACKWARD _BV(PB0)
#define RIGHT_FORWARD _BV(PB1)
#define RIGHT_BACKWARD _BV(PB2)
#define LIGHT 0x07 /* PC2 to PC0 */

static struct ring received, to_send;
static volatile uint16_t silence; /* ms since the last byte, as far as it matters */
static volatile uint8_t byte_lost; /* after those in the ring; set by the interrupt */

static uint8_t again, answered, clock, deadline; /* of planted bugs alone */
static volatile uint8_t running_down;

/* Both motors without power. */
static void off(void)
{
    TCCR0A &= (uint8_t)~(_BV(COM0A1) | _BV(COM0B1));
    PORTD &= (uint8_t)~LEFT_FORWARD;
    PORTB &= (uint8_t)~(LEFT_BACKWARD | RIGHT_FORWARD | RIGHT_BACKWARD);
}

/* -- interrupts ------------------------------------------------------------------------------ */

ISR(USART_RX_vect)
{
    uint8_t spoilt = UCSR0A & (_BV(FE0) | _BV(DOR0) | _BV(UPE0));
    uint8_t byte = UDR0;

    silence = 0;
    deadline = (uint8_t)(clock + ROBOT_CAR_TRUNCATION_TIMEOUT_MS);
    if (BUG_WATCHDOG_STARVES || BUG_STATE_KEPT_OVER_WATCHDOG)
        wdt_reset();
    if (BUG_DEAF_WHILE_ANSWERING && UCSR0B & _BV(UDRIE0))
        return;
    if (spoilt || byte_lost || !ring_put(&received, byte))
        byte_lost = 1;
}

ISR(USART_UDRE_vect)
{
    if (ring_empty(&to_send)) {
        UCSR0B &= (uint8_t)~_BV(UDRIE0);
    } else {
        UDR0 = ring_take(&to_send);
        if (BUG_ANSWER_TWICE_WHEN_QUEUED && !ring_empty(&to_send) && (again ^= 1))
            to_send.out = (uint8_t)((to_send.out - 1u) & (RING_SIZE - 1u));
    }
}

ISR(TIMER1_COMPA_vect)
{
    if (silence < UINT16_MAX)
        silence++;
    clock++;
    if (running_down && !--running_down)
        off();
}

/* -- what the robot asks for ----------------------------------------------------------------- */

void board_answer(uint8_t code)
{
    if (BUG_ANSWER_LOST_WHEN_BUSY && UCSR0B & _BV(UDRIE0))
        return;
    if (BUG_FIRST_ANSWER_LOST && !answered) {
        answered = 1;
        return;
    }
    while (!ring_put(&to_send, code))
        ; /* the interrupt makes room */
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
        UCSR0B |= _BV(UDRIE0);
}

void board_drive(int16_t left, int16_t right)
{
    if (BUG_RUNS_DOWN && !left && !right) {
        running_down = running_down ? running_down : 250;
        return;
    }
    running_down = 0;
    off(); /* no direction changes under power */
    PORTD = (uint8_t)((PORTD & ~LEFT_FORWARD) | (left > 0 ? LEFT_FORWARD : 0));
    PORTB = (uint8_t)((PORTB & ~(LEFT_BACKWARD | RIGHT_FORWARD | RIGHT_BACKWARD))
                      | (left < 0 ? LEFT_BACKWARD : 0) | (right > 0 ? RIGHT_FORWARD : 0)
                      | (right < 0 ? RIGHT_BACKWARD : 0));
    OCR0A = (uint8_t)((left < 0 ? -left : left) + BUG_FULL_SPEED_WRAPS);
    OCR0B = (uint8_t)((right < 0 ? -right : right) + BUG_FULL_SPEED_WRAPS);
    if (left)
        TCCR0A |= _BV(COM0A1);
    if (right)
        TCCR0A |= _BV(COM0B1);
}

void board_light(uint8_t rgb)
{
    if (BUG_LIGHT_REVERSED)
        rgb = (uint8_t)((rgb & 1) << 2 | (rgb & 2) | (rgb >> 2 & 1));
    PORTC = (uint8_t)((PORTC & ~LIGHT) | (rgb & LIGHT));
    if (BUG_LIGHT_STOPS_A_MOTOR)
        PORTB = (uint8_t)(PORTB & ~(RIGHT_FORWARD | RIGHT_BACKWARD));
}

/* -- start ----------------------------------------------------------------------------------- */

/* After a reset by the watchdog it still runs, with its shortest time. */
void watchdog_off(void) __attribute__((naked, used, section(".init3")));

void watchdog_off(void)
{
    MCUSR = 0;
    wdt_disable();
}

static void board_init(void)
{
    DDRD |= LEFT_PWM | RIGHT_PWM | LEFT_FORWARD;
    DDRB |= LEFT_BACKWARD | RIGHT_FORWARD | (BUG_BACKWARD_PIN_NO_OUTPUT ? 0 : RIGHT_BACKWARD);
    DDRC |= LIGHT;

    TCCR0A = _BV(WGM01) | _BV(WGM00); /* fast PWM: 255 is on; a wheel at rest is not connected */
    TCCR0B = _BV(CS01) | _BV(CS00);

    OCR1A = F_CPU / 64 / 1000 - 1;
    TCCR1B = _BV(WGM12) | _BV(CS11) | _BV(CS10);
    TIMSK1 = BUG_NO_TICK ? 0 : _BV(OCIE1A);

    PORTD |= _BV(PD0); /* a line that is not plugged in is idle */
    UCSR0A = _BV(U2X0);
    UBRR0 = (uint16_t)((F_CPU / 4 / ROBOT_CAR_BAUD - 1) / 2);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
}

/* Whether the line has been silent for so long that a frame which lacks data is over. */
static uint8_t is_over(void)
{
    static uint16_t now;

    if (BUG_CLOCK_WRAPS)
        return clock > deadline;
    if (BUG_STALE_SILENCE && robot_expects_pause() && now)
        return now > ROBOT_CAR_TRUNCATION_TIMEOUT_MS;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
        now = silence;
    return now > ROBOT_CAR_TRUNCATION_TIMEOUT_MS;
}

/* Sleep until the next interrupt, which is the next tick at the latest. */
static void rest(void)
{
    cli();
    if (ring_empty(&received) && !byte_lost) {
        sleep_enable();
        sei(); /* the instruction after it still runs before any interrupt: none is missed */
        sleep_cpu();
        sleep_disable();
    }
    sei();
}

/* Tell the robot; a byte that came meanwhile is one that it would throw away. */
static void lose(void)
{
    robot_lost_byte();
    byte_lost = 0;
}

int main(void)
{
    board_init();
    robot_reset();
    wdt_enable(WDTO_120MS);
    sei();
    for (;;) {
        if (!BUG_WATCHDOG_STARVES && !BUG_STATE_KEPT_OVER_WATCHDOG)
            wdt_reset();
        if (!ring_empty(&received))
            robot_receive(ring_take(&received));
        else if (byte_lost)
            lose();
        else if (is_over() && robot_expects_pause())
            robot_timed_out();
        else
            rest();
    }
}
