/* The checkers, in three groups. */
#ifndef CAMPAIGN_CHECKERS_TABLE_H
#define CAMPAIGN_CHECKERS_TABLE_H

#include "campaign/checkers/checker.h"

typedef enum {
    CHECKER_NEVER,     /* what may never happen */
    CHECKER_IN_TIME,   /* what must happen in time */
    CHECKER_SOMETIMES, /* what must have happened in some run of a campaign */
} checker_group_t;

/* Worlds that a checker judges, by their clients. */
enum {
    CHECKER_SPEED = 1u << WORLD_CLIENT_SPEED,
    CHECKER_POSITION = 1u << WORLD_CLIENT_POSITION,
    CHECKER_CANOPEN = 1u << WORLD_CLIENT_CANOPEN,
    CHECKER_DBC = CHECKER_SPEED | CHECKER_POSITION,
    CHECKER_MOTION = CHECKER_POSITION | CHECKER_CANOPEN,
    CHECKER_ALL = CHECKER_SPEED | CHECKER_MOTION,
};

typedef struct {
    checker_group_t group;
    unsigned worlds;
    const checker_t *checker;
} checkers_row_t;

extern const checkers_row_t checkers_table[];
extern const unsigned checkers_count;

#endif
