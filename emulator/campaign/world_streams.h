/* Streams of random numbers of a seed; the index within one is the number of the draw. */
#ifndef CAMPAIGN_WORLD_STREAMS_H
#define CAMPAIGN_WORLD_STREAMS_H

enum {
    STREAM_BOARD = 1,
    STREAM_IMPERFECTION,
    STREAM_SPEED,
    STREAM_LOAD,
    STREAM_SCRIPT,
    STREAM_FAULT_ON,
    STREAM_FAULT,
    STREAM_BUS,
    STREAM_GATES,
    STREAM_TORQUE,
    STREAM_REQUEST,
    STREAM_MOTION, /* of worlds of positions alone */
    STREAM_MOTION_TARGET,
    STREAM_MOTION_EVENT,
};

#define DEGRADED_SHARE 0.1 /* of the seeds */

#endif
