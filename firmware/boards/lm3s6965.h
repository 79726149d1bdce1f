/* The LM3S6965's registers, as far as the robot needs them. */
#ifndef LM3S6965_H
#define LM3S6965_H

#include <stdint.h>

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

#endif
