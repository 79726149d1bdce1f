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

#include "bugs.h"
#include "protocol.h"
#include "ring.h"
#include "robot.h"

#define HZ 50000000u

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define BIT(n) (1u << (n))

/* System control */
#define RIS REGISTER(0x400fe050) /* raw interrupts */
#define RIS_PLL_LOCKED BIT(6)
#define RCC REGISTER(0x400fe060) /* clocks while running */
#define RCC_MOSC_OFF BIT(0)
#define RCC_SOURCE (3u << 4) /* 0: the crystal */
#define RCC_XTAL (15u << 6)
#define RCC_XTAL_8_MHZ (14u << 6)
#define RCC_BYPASS BIT(11)
#define RCC_PLL_OFF BIT(13)
#define RCC_PWM_BY_64 (BIT(20) | 5u << 17)
#define RCC_DIVIDE BIT(22)
#define RCC_DIVISOR (15u << 23)
#define RCC_200_MHZ_BY_4 (3u << 23)
#define RCGC0 REGISTER(0x400fe100) /* who has a clock */
#define RCGC0_WATCHDOG BIT(3)
#define RCGC0_PWM BIT(20)
#define RCGC1 REGISTER(0x400fe104)
#define RCGC1_UART0 BIT(0)
#define RCGC2 REGISTER(0x400fe108)
#define RCGC2_PORTS (BIT(0) | BIT(1) | BIT(3)) /* A, B, D */

/* Ports; DATA's address says which bits are meant, the others stay as they are */
#define PORT_A 0x40004000u
#define PORT_B 0x40005000u
#define PORT_D 0x40007000u
#define DATA(port, bits) REGISTER((port) + ((bits) << 2))
#define DIR(port) REGISTER((port) + 0x400)
#define AFSEL(port) REGISTER((port) + 0x420)
#define DEN(port) REGISTER((port) + 0x51c)

/* UART 0, a PL011 */
#define UART_DR REGISTER(0x4000c000)
#define UART_DR_SPOILT 0xf00u /* framing, parity, break, overrun */
#define UART_FR REGISTER(0x4000c018)
#define UART_FR_RX_EMPTY BIT(4)
#define UART_FR_TX_FULL BIT(5)
#define UART_IBRD REGISTER(0x4000c024)
#define UART_FBRD REGISTER(0x4000c028)
#define BAUD_DIVISOR ((HZ * 4 + ROBOT_CAR_BAUD / 2) / ROBOT_CAR_BAUD) /* of HZ / 16, in 64ths */
#define UART_LCRH REGISTER(0x4000c02c)
#define UART_LCRH_8_BITS (3u << 5)
#define UART_CTL REGISTER(0x4000c030)
#define UART_CTL_ON (BIT(0) | BIT(8) | BIT(9))
#define UART_IM REGISTER(0x4000c038)
#define UART_ICR REGISTER(0x4000c044)
#define UART_RX BIT(4)
#define UART_TX BIT(5)

/* The PWM module */
#define PWM_ENABLE REGISTER(0x40028008)
#define PWM_LEFT BIT(2)
#define PWM_RIGHT BIT(3)
#define PWM_CTL REGISTER(0x40028080)
#define PWM_LOAD REGISTER(0x40028090)
#define PWM_CMPA REGISTER(0x40028098)
#define PWM_CMPB REGISTER(0x4002809c)
#define PWM_GENA REGISTER(0x400280a0)
#define PWM_GENA_HIGH_UNTIL_CMPA (3u << 2 | 2u << 6)
#define PWM_GENB REGISTER(0x400280a4)
#define PWM_GENB_HIGH_UNTIL_CMPB (3u << 2 | 2u << 10)
#define PWM_PERIOD 255u

/* The watchdog */
#define WDT_LOAD REGISTER(0x40000000)
#define WDT_CTL REGISTER(0x40000008)
#define WDT_CTL_RESETS 3u
#define WDT_ICR REGISTER(0x4000000c)

/* The processor's own */
#define SYST_CSR REGISTER(0xe000e010)
#define SYST_CSR_TICKS 7u
#define SYST_RVR REGISTER(0xe000e014)
#define SYST_CVR REGISTER(0xe000e018)
#define NVIC_ENABLE REGISTER(0xe000e100)
#define NVIC_PEND REGISTER(0xe000e200)
#define NVIC_UART0 BIT(5)

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
        if (!(byte & UART_DR_SPOILT))
            ring_put(&received, (uint8_t)byte);
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

/* From the oscillator inside, which is too coarse for a serial line, to the crystal and the PLL. */
static void clock_init(void)
{
    RCC = (RCC | RCC_BYPASS) & ~RCC_DIVIDE;
    RCC &= ~RCC_MOSC_OFF;
    RCC = (RCC & ~(RCC_XTAL | RCC_SOURCE | RCC_PLL_OFF)) | RCC_XTAL_8_MHZ;
    RCC = (RCC & ~RCC_DIVISOR) | RCC_200_MHZ_BY_4 | RCC_DIVIDE | RCC_PWM_BY_64;
    while (!(RIS & RIS_PLL_LOCKED))
        ;
    RCC &= ~RCC_BYPASS;
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
    if (ring_empty(&received))
        __asm__ volatile("wfi");
    __asm__ volatile("cpsie i" ::: "memory");
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
        else if (is_over() && robot_expects_data())
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
