#include <avr/io.h>
#include <avr/wdt.h>

int main(void)
{
    uint8_t why = MCUSR, count = 0;
    MCUSR &= _BV(EXTRF);
    wdt_disable();
    UCSR0A = _BV(U2X0);
    UBRR0 = 16;
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0);
    wdt_enable(WDTO_2S);
    for (;;) {
        while (!(UCSR0A & _BV(RXC0)));
        uint8_t byte = UDR0;
        wdt_reset();
        while (!(UCSR0A & _BV(UDRE0)));
        UDR0 = ++count | why << 4;
        if (byte == 'W') {
            WDTCSR = _BV(WDCE) | _BV(WDE);
            WDTCSR = _BV(WDE);
            for (;;);
        }
    }
}
