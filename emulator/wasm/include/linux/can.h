/* The frames of linux/can.h, in Linux's layout, for a system that has no such header. */
#ifndef LINUX_CAN_H
#define LINUX_CAN_H

#include <stdint.h>

#define CAN_EFF_FLAG 0x80000000u
#define CAN_RTR_FLAG 0x40000000u
#define CAN_ERR_FLAG 0x20000000u
#define CAN_SFF_MASK 0x000007FFu
#define CAN_EFF_MASK 0x1FFFFFFFu
#define CAN_ERR_MASK 0x1FFFFFFFu

#define CAN_MAX_DLEN 8
#define CAN_MAX_RAW_DLC 15
#define CANFD_MAX_DLEN 64
#define CANFD_BRS 0x01
#define CANFD_ESI 0x02
#define CANFD_FDF 0x04

typedef uint32_t canid_t;

struct can_frame {
    canid_t can_id;
    union {
        uint8_t len;
        uint8_t can_dlc;
    };
    uint8_t __pad;
    uint8_t __res0;
    uint8_t len8_dlc;
    uint8_t data[CAN_MAX_DLEN] __attribute__((aligned(8)));
};

struct canfd_frame {
    canid_t can_id;
    uint8_t len;
    uint8_t flags;
    uint8_t __res0;
    uint8_t __res1;
    uint8_t data[CANFD_MAX_DLEN] __attribute__((aligned(8)));
};

#define CAN_MTU sizeof(struct can_frame)
#define CANFD_MTU sizeof(struct canfd_frame)

#endif
