/* Arms a drive, runs it at 600 r/min for two seconds by default, and stops it: docs/can/protocol.md in C.
 *     cc -o /tmp/run_600_rpm tools/examples/run_600_rpm.c && /tmp/run_600_rpm INTERFACE [SECONDS] */
#include <linux/can.h>
#include <net/if.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

static void send_protected(int can, unsigned identifier, unsigned data_id, uint8_t length, uint8_t counter,
                           uint8_t what, uint32_t value) {
    struct can_frame frame = {.can_id = identifier, .len = length, .data = {0, 0, counter, what}};
    memcpy(frame.data + 4, &value, (size_t)length - 4); /* little endian, as the processor */
    unsigned crc = 0xFFFF;
    for (int i = 2; i < length + 2; i++) {
        crc ^= (i < length ? frame.data[i] : data_id >> 8 * (i - length) & 0xFF) << 8;
        for (int bit = 0; bit < 8; bit++) {
            crc = (crc << 1 ^ (crc & 0x8000 ? 0x1021 : 0)) & 0xFFFF;
        }
    }
    frame.data[0] = crc & 0xFF;
    frame.data[1] = (uint8_t)(crc >> 8);
    if (write(can, &frame, sizeof frame) != sizeof frame) {
        perror("write");
        exit(1);
    }
}

int main(int argc, char **argv) {
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = argc > 1 ? (int)if_nametoindex(argv[1]) : 0};
    int can = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (address.can_ifindex == 0 || bind(can, (struct sockaddr *)&address, sizeof address) < 0) {
        perror(argc > 1 ? argv[1] : "run_600_rpm INTERFACE [SECONDS]");
        return 1;
    }
    uint32_t start_us = 0, now_us = 0, sent = 0, challenge,
             end_us = argc > 2 ? (uint32_t)(1e6 * atof(argv[2])) : 2000000;
    enum { RUN = 1, STOP = 2, STATE_RUN = 2 } request = RUN;
    int state = STATE_RUN;
    struct can_frame in;
    while ((request == RUN || state == STATE_RUN) && read(can, &in, sizeof in) == sizeof in) {
        if (in.can_id == 0x18E && request == RUN && !(in.data[4] & 4)) { /* DRIVE_ARMING, not armed */
            const uint8_t confirm = (in.data[4] & 3) == 1;               /* it has a challenge for a run */
            memcpy(&challenge, in.data, 4);
            send_protected(can, 0x082, 0x5A20, 8, confirm, confirm, confirm ? ~challenge : 0);
        } else if (in.can_id == 0x180) { /* DRIVE_STATUS */
            memcpy(&now_us, in.data, 4);
            state = in.data[4] & 0xF;
            start_us = sent ? start_us : now_us;
            if (now_us - start_us >= 10000 * sent) {
                request = now_us - start_us < end_us ? RUN : STOP;
                send_protected(can, 0x080, 0x5A1E, 7, (uint8_t)sent++, (uint8_t)request, 600000);
            }
        }
    }
    return printf("state %d\n", state) < 0;
}
