/* A client or a server of libmodbus: modbus_peer client|server TTY. The client fails where an answer
   is not what the server's registers and coils are due to give. */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { UNIT = 17, SIZE = 100 };

static void require(int holds, const char *what)
{
    if (!holds) {
        fprintf(stderr, "%s: %s\n", what, modbus_strerror(errno));
        exit(1);
    }
}

static int raw(modbus_t *line, int function, const uint8_t *data, int size)
{
    uint8_t request[64] = {UNIT, function}, answer[MODBUS_RTU_MAX_ADU_LENGTH];
    memcpy(request + 2, data, size);
    require(modbus_send_raw_request(line, request, size + 2) == size + 4, "raw request");
    require(modbus_receive_confirmation(line, answer) == 5, "raw answer");
    return answer[1] == (function | 0x80) ? answer[2] : 0;
}

static void client(modbus_t *line)
{
    static const uint8_t none[] = {0, 0, 0, 0};
    uint8_t bits[SIZE], pattern[10] = {1, 0, 1, 1, 0, 0, 1, 1, 0, 1};
    uint16_t words[SIZE], four[4] = {0xFFFF, 0x8000, 0x0102, 7};

    modbus_set_response_timeout(line, 30, 0); /* a busy machine answers late */
    require(modbus_read_bits(line, 0, SIZE, bits) == SIZE && bits[3] && !bits[4], "01");
    require(modbus_read_input_bits(line, 1, 9, bits) == 9 && bits[0] && !bits[1], "02");
    require(modbus_read_registers(line, 0, SIZE, words) == SIZE && words[99] == 1099, "03");
    require(modbus_read_input_registers(line, 5, 1, words) == 1 && words[0] == 2005, "04");
    require(modbus_write_bit(line, 4, 1) == 1, "05");
    require(modbus_read_bits(line, 4, 1, bits) == 1 && bits[0], "05 read back");
    require(modbus_write_register(line, 6, 0x1234) == 1, "06");
    require(modbus_write_bits(line, 20, 10, pattern) == 10, "0F");
    require(modbus_read_bits(line, 20, 10, bits) == 10 && !memcmp(bits, pattern, 10), "0F read back");
    require(modbus_write_registers(line, 30, 4, four) == 4, "10");
    require(modbus_mask_write_register(line, 6, 0xF2, 0x25) == 1, "16");
    require(modbus_write_and_read_registers(line, 40, 4, four, 30, 4, words) == 4 &&
            !memcmp(words, four, sizeof four), "17");
    require(modbus_read_registers(line, 99, 2, words) < 0 && errno == EMBXILADD, "02 expected");
    require(modbus_write_register(line, 100, 1) < 0 && errno == EMBXILADD, "02 expected");
    require(raw(line, 0x03, none, 4) == MODBUS_EXCEPTION_ILLEGAL_DATA_VALUE, "03 expected");
    require(raw(line, 0x41, none, 0) == MODBUS_EXCEPTION_ILLEGAL_FUNCTION, "01 expected");
    require(modbus_set_slave(line, MODBUS_BROADCAST_ADDRESS) == 0, "address");
    modbus_set_response_timeout(line, 0, 1000); /* nobody answers a broadcast */
    modbus_write_register(line, 50, 0x4321);
    modbus_set_response_timeout(line, 30, 0);
    require(modbus_set_slave(line, UNIT) == 0, "address");
    require(modbus_read_registers(line, 50, 1, words) == 1 && words[0] == 0x4321, "broadcast");
}

static void serve(modbus_t *line)
{
    uint8_t request[MODBUS_RTU_MAX_ADU_LENGTH];
    modbus_mapping_t *map = modbus_mapping_new(SIZE, SIZE, SIZE, SIZE);
    require(map != NULL, "mapping");
    for (int at = 0; at < SIZE; at++) {
        map->tab_bits[at] = at % 3 == 0;
        map->tab_input_bits[at] = at % 2;
        map->tab_registers[at] = 1000 + at;
        map->tab_input_registers[at] = 2000 + at;
    }
    puts("ready");
    fflush(stdout);
    for (;;) {
        int size = modbus_receive(line, request);
        if (size > 0)
            modbus_reply(line, request, size, map);
        else
            require(errno != EIO && errno != EBADF, "line");
    }
}

int main(int count, char **words)
{
    require(count == 3, "usage");
    modbus_t *line = modbus_new_rtu(words[2], 19200, 'N', 8, 1);
    require(line && modbus_set_slave(line, UNIT) == 0 && modbus_connect(line) == 0, "open");
    if (strcmp(words[1], "server") == 0)
        serve(line);
    client(line);
    return 0;
}
