/* LM3S6965 (ARM Cortex-M3) at 50 MHz from a crystal of 8 MHz, as on the board EK-LM3S6965.
 *
 * PA0, PA1      serial line, by interrupts and rings
 * PB0, PB1      PWM of the left and the right motor (generator 1, 3.06 kHz)
 * PD4, PD5      direction of the left motor
 * PD6, PD7      direction of the right motor
 * PB6 PB5 PB4   the diode's R, G and B
 * SysTick       a tick each millisecond: the pause inside a frame
 * watchdog      resets a main loop that hangs
 *
 * Generator 0 would do for the motors too, but that board has a LED and a loudspeaker on its pins.
 */
#include <stdint.h>

#include "boards/lm3s6965.h"
#include "bugs.h"
#include "protocol.h"
#include "ring.h"
#include "robot.h"

#define HZ 50000000u
#define BAUD_DIVISOR ((HZ * 4 + ROBOT_CAR_BAUD / 2) / ROBOT_CAR_BAUD) /* of HZ / 16, in 64ths */
#define PWM_PERIOD 255u /* a step for each speed */

#define LEFT_FORWARD BIT(4)
#define LEFT_BACKWARD BIT(5)
#define RIGHT_FORWARD BIT(6)
#define RIGHT_BACKWARD BIT(7)
#define DIRECTIONS (LEFT_FORWARD | LEFT_BACKWARD | RIGHT_FORWARD | RIGHT_BACKWARD)
#define MOTORS (BIT(0) | BIT(1))
#define LIGHT_SHIFT 4
#define LIGHT (7u << LIGHT_SHIFT)
#define LINE (BIT(0) | BIT(1))

static struct ring received, to_send;
static volatile uint16_t silence; /* ms since the last byte, as far as it matters */
static volatile uint8_t byte_lost; /* after those in the ring; set by the interrupt */

/* Both motors without power. */
static void off(void)
{
    PWM_ENABLE = 0;
    DATA(PORT_D, DIRECTIONS) = 0;
}

/* The first time that nobody feeds it passes, the second resets: half a second each.
 *
 * It is so long since under an emulator the time is the host's.
 */
static void feed_watchdog(void)
{
    WDT_ICR = 0;
}

/* -- interrupts ------------------------------------------------------------------------------ */

/* A byte has come, the next may go, or board_answer asks for it. */
static void uart0(void)
{
    UART_ICR = UART_TX;
    while (!(UART_FR & UART_FR_RX_EMPTY)) {
        uint32_t byte = UART_DR;

        silence = 0;
        if (BUG_WATCHDOG_STARVES || BUG_STATE_KEPT_OVER_WATCHDOG)
            feed_watchdog();
        if (byte & UART_DR_SPOILT || byte_lost || !ring_put(&received, (uint8_t)byte))
            byte_lost = 1;
    }
    while (!ring_empty(&to_send) && !(UART_FR & UART_FR_TX_FULL))
        UART_DR = ring_take(&to_send);
}

static void tick(void)
{
    if (silence < UINT16_MAX)
        silence++;
}

/* A fault of the program, or an interrupt that nobody asked for. */
static void lost(void)
{
    off();
    for (;;)
        ; /* until the watchdog resets */
}

/* -- what the robot asks for ----------------------------------------------------------------- */

void board_answer(uint8_t code)
{
    while (!ring_put(&to_send, code))
        ; /* the interrupt makes room */
    NVIC_PEND = NVIC_UART0;
}

/* When the counter, on its way down, meets the comparator, the pulse ends; past LOAD never. */
static uint16_t end_of_pulse(int16_t speed)
{
    return (uint16_t)(PWM_PERIOD - 1u - (uint16_t)(speed < 0 ? -speed : speed));
}

void board_drive(int16_t left, int16_t right)
{
    off(); /* no direction changes under power */
    DATA(PORT_D, DIRECTIONS) = (left > 0 ? LEFT_FORWARD : 0) | (left < 0 ? LEFT_BACKWARD : 0)
                               | (right > 0 ? RIGHT_FORWARD : 0) | (right < 0 ? RIGHT_BACKWARD : 0);
    PWM_CMPA = end_of_pulse(left);
    PWM_CMPB = end_of_pulse(right);
    PWM_ENABLE = (left ? PWM_LEFT : 0) | (right ? PWM_RIGHT : 0);
}

void board_light(uint8_t rgb)
{
    DATA(PORT_B, LIGHT) = (uint32_t)rgb << LIGHT_SHIFT;
}

/* -- start ----------------------------------------------------------------------------------- */

/* So many turns, each of a few clock cycles. */
static void wait(uint32_t turns)
{
    while (turns--)
        __asm__ volatile("");
}

/* From the oscillator inside, which is too coarse for a serial line, to the crystal and the PLL. */
static void clock_init(void)
{
    RCC = (RCC | RCC_BYPASS) & ~RCC_DIVIDE;
    RCC &= ~RCC_MOSC_OFF;
    wait(HZ / 100); /* a crystal takes milliseconds to swing; until then nothing may run on it */
    RCC = (RCC & ~(RCC_XTAL | RCC_SOURCE | RCC_PLL_OFF)) | RCC_XTAL_8_MHZ;
    RCC = (RCC & ~RCC_DIVISOR) | RCC_200_MHZ_BY_4 | RCC_DIVIDE | RCC_PWM_BY_64;
    while (!(RIS & RIS_PLL_LOCKED))
        ;
    RCC &= ~RCC_BYPASS;
    wait(16); /* for the switch itself */
}

static void board_init(void)
{
    clock_init();
    RCGC0 |= RCGC0_WATCHDOG | RCGC0_PWM;
    RCGC1 |= RCGC1_UART0;
    RCGC2 |= RCGC2_PORTS;
    (void)RCGC2; /* their clocks take three cycles to come */
    (void)RCGC2;

    DIR(PORT_D) |= DIRECTIONS;
    DEN(PORT_D) |= DIRECTIONS;
    DIR(PORT_B) |= LIGHT;
    AFSEL(PORT_B) |= MOTORS;
    DEN(PORT_B) |= LIGHT | MOTORS;
    AFSEL(PORT_A) |= LINE;
    DEN(PORT_A) |= LINE;

    PWM_GENA = PWM_GENA_HIGH_UNTIL_CMPA;
    PWM_GENB = PWM_GENB_HIGH_UNTIL_CMPB;
    PWM_LOAD = PWM_PERIOD - 1;
    PWM_CTL = 1;

    SYST_RVR = HZ / 1000 - 1;
    SYST_CVR = 0;
    SYST_CSR = SYST_CSR_TICKS;

    /* Without its FIFOs each byte interrupts at once, and the pause is counted from it. */
    UART_IBRD = BAUD_DIVISOR / 64;
    UART_FBRD = BAUD_DIVISOR % 64;
    UART_LCRH = UART_LCRH_8_BITS;
    UART_IM = UART_RX | UART_TX;
    UART_CTL = UART_CTL_ON;
    NVIC_ENABLE = NVIC_UART0;

    WDT_LOAD = HZ / 2;
    WDT_CTL = WDT_CTL_RESETS;
}

/* Whether the line has been silent for so long that a frame which lacks data is over. */
static uint8_t is_over(void)
{
    return silence > ROBOT_CAR_TRUNCATION_TIMEOUT_MS;
}

/* Sleep until the next interrupt, which is the next tick at the latest.
 *
 * One that comes after the ring was looked at is held off, yet ends the sleep: none is missed.
 */
static void rest(void)
{
    __asm__ volatile("cpsid i" ::: "memory");
    if (ring_empty(&received) && !byte_lost)
        __asm__ volatile("wfi");
    __asm__ volatile("cpsie i" ::: "memory");
}

/* Tell the robot; a byte that came meanwhile is one that it would throw away. */
static void lose(void)
{
    robot_lost_byte();
    byte_lost = 0;
}

static void run(void)
{
    board_init();
    robot_reset();
    for (;;) {
        if (!BUG_WATCHDOG_STARVES && !BUG_STATE_KEPT_OVER_WATCHDOG)
            feed_watchdog();
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

extern uint32_t data_image[], data_begin[], data_end[], bss_begin[], bss_end[], stack_top[];

/* The first that runs: variables get their first values. */
void reset(void)
{
    uint32_t *to;
    const uint32_t *from = data_image;

    for (to = data_begin; to < data_end;)
        *to++ = *from++;
    for (to = bss_begin; to < bss_end;)
        *to++ = 0;
    run();
}

/* Where the processor finds its stack and its handlers; 16 of its own, then the chip's. */
static void (*const vectors[])(void) __attribute__((section(".vectors"), used)) = {
    (void (*)(void))stack_top,
    reset,
    [2 ... 14] = lost,
    [15] = tick,
    [16 ... 20] = lost,
    [21] = uart0,
    [22 ... 59] = lost,
};
