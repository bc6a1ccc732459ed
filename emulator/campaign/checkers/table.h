/* The checkers, in three groups. */
#ifndef CAMPAIGN_CHECKERS_TABLE_H
#define CAMPAIGN_CHECKERS_TABLE_H

#include "campaign/checkers/checker.h"

typedef enum {
    CHECKER_NEVER,     /* what may never happen */
    CHECKER_IN_TIME,   /* what must happen in time */
    CHECKER_SOMETIMES, /* what must have happened in some run of a campaign */
} checker_group_t;

typedef struct {
    checker_group_t group;
    const checker_t *checker;
} checkers_row_t;

extern const checkers_row_t checkers_table[];
extern const unsigned checkers_count;

#endif
