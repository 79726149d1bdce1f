#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <util/delay.h>

static uint8_t taken(void)
{
    while (!(UCSR0A & _BV(RXC0)));
#ifdef READS_LATE
    _delay_us(60);
#endif
    return UDR0;
}

int main(void)
{
#ifdef DOUBLE_SPEED
    UCSR0A = _BV(U2X0); UBRR0 = 16;
#elif defined DOUBLED_LATER
    UBRR0 = 16; UCSR0A = _BV(U2X0); /* the emulator has taken the baud in already */
#else
    UBRR0 = 8;
#endif
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
#ifdef TWO_STOP_BITS
    UCSR0C |= _BV(USBS0);
    UBRR0 = 8; /* the emulator takes it in with the divider */
#endif
    UCSR0B = _BV(RXEN0) | _BV(TXEN0);
    DDRC = PORTC = 5; DDRD = 0xE0; PORTD = 0xC0; /* red and blue; the left wheel, forward */
    for (;;) {
        uint8_t byte = taken();
        while (!(UCSR0A & _BV(UDRE0)));
        UDR0 = byte;
#ifdef SLEEPS_FOR_EVER
        cli(); sleep_enable(); sleep_cpu();
#elif defined RUNS_OFF
        ((void (*)(void))0x3f00)();
#elif defined HANGS
        for (;;);
#endif
    }
}
