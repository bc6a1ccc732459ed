#include "control/position/position_loop.h"

#include "fixed/compiler.h"
#include "fixed/fixed.h"

/* Ticks at the torque limit and without motion that are a mechanical stop: 50 ms. */
#define BLOCKED_TICKS 50u

/* A rotor that turns no faster stands: 2^-10 rev/s. */
#define STANDS (PROFILE_POSITION_MAX >> 34)

#define TO_PROFILE 16 /* 2^-32 to 2^-48 rev */

/* The jerk that is found in a tick acts in the next one, and leads to its end. */
#define AHEAD_TICKS 2

static int64_t limited(int64_t position) {
    return fixed_clamp_64(position, -POSITION_MAX, POSITION_MAX);
}

static int64_t to_profile(int64_t position) {
    return position * (1 << TO_PROFILE);
}

/* Another zero, with which the reference and the rotor keep their places. */
COLD NOINLINE static void move_zero(position_t *position, int64_t zero) {
    const int64_t moved = to_profile(position->zero - zero);
    position->zero = zero;
    position->profile.start.x += moved;
    position->profile.end.x += moved;
    position->target += moved;
}

static void count(position_t *position, uint32_t encoder_angle, uint32_t angle) {
    if (!position->started) {
        position->started = true;
        position->counted = encoder_angle;
    } else {
        position->counted += (int32_t)(encoder_angle - position->encoder_angle);
    }
    const int64_t from_zero = position->counted - position->zero;
    if (from_zero > POSITION_MAX + POSITION_ONE_REV || from_zero < -POSITION_MAX - POSITION_ONE_REV) {
        move_zero(position, position->counted - (position->counted & (POSITION_ONE_REV - 1))); /* the range has ended */
        position->status.homed = false;
    }
    position->encoder_angle = encoder_angle;
    position->status.position = position->counted - position->zero + (int32_t)(angle - encoder_angle);
}

void position_follow(position_t *position, uint32_t encoder_angle, uint32_t angle) {
    position_status_t *status = &position->status;
    count(position, encoder_angle, angle);
    if (status->active && position->homing != POSITION_HOMING_IDLE) {
        status->homing_failed = true;
    }
    position->homing = POSITION_HOMING_IDLE;
    status->active = status->homing = status->in_position = status->reference_ended = false;
    status->following_error = status->limited = false;
    status->reference = status->position;
    status->error = 0;
    status->speed_reference_q22 = 0;
}

/* The reference is where the rotor is and as fast as it. */
COLD NOINLINE static void begin_here(position_t *position, const position_sample_t *sample) {
    const int64_t speed = sample->speed > STANDS || sample->speed < -STANDS ? sample->speed : 0;
    profile_begin_moving(&position->profile, to_profile(position->status.position), speed);
    position->phase = 0;
    position->cubic_ticks = 0;
    position->stops = false;
}

COLD NOINLINE static void stop(position_t *position, const profile_limits_t *limits) {
    if (!position->stops) {
        position->target = profile_stop(limits, &position->profile.end);
        position->stops = true;
    }
}

static void go_to(position_t *position, const position_command_t *command, int64_t target) {
    position->target = fixed_clamp_64(target, command->lowest, command->highest);
    position->status.limited = position->target != target;
    position->stops = false;
}

/* End stops that have become narrower since the set point came shorten its move; they move no reference that rests. */
static void keep_within(position_t *position, const position_command_t *command) {
    const int64_t here = position->profile.end.x;
    const int64_t low = command->lowest < here ? command->lowest : here;
    const int64_t high = command->highest > here ? command->highest : here;
    position->status.limited |= position->target < low || position->target > high;
    position->target = fixed_clamp_64(position->target, low, high);
}

/* Calls the place `here` (counted, 2^-32 rev) by a name, and moves the reference with it. */
COLD NOINLINE static void set_zero(position_t *position, int64_t here, int64_t name) {
    position->status.position += position->zero - (here - name);
    move_zero(position, here - name);
    position->status.homed = true;
}

static void end_homing(position_t *position, bool found) {
    position->homing = POSITION_HOMING_IDLE;
    position->status.homing_failed = !found;
}

COLD static void begin_homing(position_t *position, const position_set_point_t *set_point) {
    position->status.homed = position->status.homing_failed = false;
    position->homing = POSITION_HOMING_SEEKS;
    position->turn = position->counted >> 32;
    position->blocked_ticks = 0;
    if (set_point->homing == POSITION_HOMING_HERE) {
        const int64_t place = (position->profile.end.x >> TO_PROFILE) + position->zero;
        set_zero(position, place, limited(set_point->target));
        position->homing = POSITION_HOMING_RETURNS;
    }
}

/* A rotor held at the torque of the homing. */
static bool blocked(position_t *position, const position_sample_t *sample) {
    const bool stands = fixed_clamp_64(sample->speed, -16 * STANDS, 16 * STANDS) == sample->speed;
    position->blocked_ticks = sample->at_torque_limit && stands ? position->blocked_ticks + 1 : 0;
    return position->blocked_ticks >= BLOCKED_TICKS;
}

COLD static void seek(position_t *position, const position_set_point_t *set_point, const position_sample_t *sample) {
    const bool forward =
        set_point->homing == POSITION_HOMING_INDEX_FORWARD || set_point->homing == POSITION_HOMING_STOP_FORWARD;
    const int64_t far = INT64_C(2) << PROFILE_FRACTION_BITS;
    position->target = position->profile.end.x + (forward ? far : -far);
    position->stops = false;
    const bool by_stop =
        set_point->homing == POSITION_HOMING_STOP_FORWARD || set_point->homing == POSITION_HOMING_STOP_BACKWARD;
    const int64_t turn = position->counted >> 32;
    if (blocked(position, sample)) {
        if (by_stop) {
            set_zero(position, position->counted, limited(set_point->target));
        }
        begin_here(position, sample); /* ahead of the rotor, it would press on with the torque of a run */
        position->target = position->profile.end.x;
        end_homing(position, by_stop);
    } else if (!by_stop && (forward ? turn > position->turn : turn < position->turn)) {
        const int64_t index = (forward ? turn : turn + 1) * POSITION_ONE_REV;
        set_zero(position, index, limited(set_point->target));
        position->homing = POSITION_HOMING_RETURNS;
    }
}

COLD NOINLINE static void home(position_t *position, const position_command_t *command, const position_sample_t *sample,
                               bool begins) {
    const position_set_point_t *set_point = &command->set_point;
    if (begins) {
        begin_homing(position, set_point);
    }
    switch (position->homing) {
    case POSITION_HOMING_SEEKS:
        seek(position, set_point, sample);
        break;
    case POSITION_HOMING_RETURNS:
        position->target = to_profile(limited(set_point->target));
        position->stops = false;
        if (profile_arrived(&position->profile, position->target)) {
            end_homing(position, true);
        }
        break;
    case POSITION_HOMING_IDLE:
    default:
        stop(position, &command->limits);
        break;
    }
}

/* Place where a reference stops that passes a position with a speed. Not inlined, and apart from the cubic: their
 * stacks do not add up. */
COLD NOINLINE static int64_t stop_after(const profile_limits_t *limits, int64_t position, int64_t speed) {
    const profile_state_t passing = {.x = position, .v = speed};
    return profile_stop(limits, &passing);
}

/* a0 and q of the cubic from the reference to a position with a speed; false when it exceeds the limits. */
COLD NOINLINE static bool begin_cubic(position_t *position, const position_command_t *command, int64_t to,
                                      int64_t speed) {
    const profile_limits_t *limits = &command->limits;
    const int64_t ticks = command->cycle.ticks;
    profile_state_t *from = &position->profile.start;
    const int64_t way = to - from->x;
    const int64_t way_max = limits->speed * (ticks + 1);
    if (way > way_max || way < -way_max) {
        return false;
    }
    const int64_t a = 2 * profile_scale(6 * way - (4 * from->v + 2 * speed) * ticks, command->cycle.half_per_ticks2);
    const int64_t q = 2 * profile_scale((from->v + speed) * ticks - 2 * way, command->cycle.half_per_ticks3);
    const int64_t last = a + 6 * q * ticks;
    const int64_t most = limits->acceleration > limits->deceleration ? limits->acceleration : limits->deceleration;
    if (a > most || a < -most || last > most || last < -most || speed > limits->speed || speed < -limits->speed) {
        return false;
    }
    from->a = a & ~INT64_C(1);
    position->profile.q = q;
    position->cubic_ticks = (uint32_t)ticks;
    return true;
}

/* Speed at the last of three targets, or two. */
static int64_t speed_of_targets(const position_t *position, const position_cycle_t *cycle, int64_t to) {
    const int64_t bound = PROFILE_SPEED_MAX * POSITION_CYCLE_TICKS_MAX;
    const int64_t before = fixed_clamp_64(to - position->past[0], -bound, bound);
    const int64_t earlier = fixed_clamp_64(position->past[0] - position->past[1], -bound, bound);
    if (position->targets < 2) {
        return 0;
    }
    return profile_scale(position->targets < 3 ? 2 * before : 3 * before - earlier, cycle->half_per_ticks);
}

/* A reference that cannot reach the target in time aims at where the targets would stop, and this place moves on with
 * them: aimed at a target, it would brake for it, and remain behind by the way of a stop. A step of the targets that is
 * more than twice the one before is a jump. */
COLD NOINLINE static void chase(position_t *position, const position_command_t *command, int64_t to) {
    const int64_t step = to - position->past[0], before = position->past[0] - position->past[1];
    const int64_t speed = 2 * profile_scale(step, command->cycle.half_per_ticks);
    const bool moves_on = step > 0 ? before >= step >> 1 : step < 0 && before <= step >> 1;
    const bool possible = speed <= command->limits.speed && speed >= -command->limits.speed;
    position->chases = position->targets > 2 && moves_on && possible;
    if (position->chases) {
        const int64_t ticks = (int64_t)command->cycle.ticks - AHEAD_TICKS;
        const int64_t rest = stop_after(&command->limits, to - speed * ticks, speed);
        position->target = fixed_clamp_64(rest, command->lowest, command->highest);
    }
}

static bool reaches(position_t *position, const position_command_t *command, int64_t to) {
    const int64_t speed = speed_of_targets(position, &command->cycle, to);
    const int64_t rest = stop_after(&command->limits, to, speed);
    return rest <= command->highest && rest >= command->lowest && begin_cubic(position, command, to, speed);
}

COLD NOINLINE static void follow_targets(position_t *position, const position_command_t *command, bool begins) {
    const int64_t to = to_profile(limited(command->set_point.target));
    if (begins) {
        position->targets = 0;
        position->silent_ticks = 0;
        position->cubic_ticks = 0;
    }
    if (begins || command->set_point.sequence != position->sequence) {
        position->targets += position->targets < 3;
        position->silent_ticks = 0;
        position->cubic_ticks = 0;
        position->chases = false;
        go_to(position, command, to);
        if (!position->status.limited && !reaches(position, command, to)) {
            chase(position, command, to);
        }
        position->past[1] = position->past[0];
        position->past[0] = to;
        return;
    }
    const uint32_t patience = 3 * command->cycle.ticks;
    position->silent_ticks += position->silent_ticks <= patience;
    if (position->silent_ticks > patience) {
        position->cubic_ticks = 0;
        position->targets = 0;
        stop(position, &command->limits);
    } else if (position->chases) {
        const int64_t step = position->past[0] - position->past[1];
        position->target = fixed_clamp_64(position->target + 2 * profile_scale(step, command->cycle.half_per_ticks),
                                          command->lowest, command->highest);
    } else if (position->cubic_ticks == 0 && position->targets > 1 && position->profile.start.x == position->target) {
        position->cubic_ticks = 1; /* late: it goes on */
        position->profile.q = 0;
        position->profile.start.a = 0;
        position->target += position->profile.start.v;
    }
}

/* Error of a reference at rest: of the count, none within it. */
static int64_t error_of_count(const position_t *position, const position_sample_t *sample, int64_t reference) {
    const int64_t begin = to_profile(position->counted - position->zero);
    const int64_t end = begin + to_profile(sample->count);
    return reference - fixed_clamp_64(reference, begin, end);
}

/* Beyond the limit at the end of a tick. */
COLD NOINLINE static void check_following(const position_law_t *parameters, position_t *position,
                                          const position_sample_t *sample) {
    position_status_t *status = &position->status;
    const int64_t error = position->profile.start.x - to_profile(status->position);
    const bool beyond = error > parameters->following_error || error < -parameters->following_error;
    if (beyond && !position_seeks_stop(position)) {
        status->following_error = true; /* once more beyond: the reference begins once more */
        end_homing(position, position->homing == POSITION_HOMING_IDLE && !status->homing_failed);
        begin_here(position, sample);
    }
    const bool arrived =
        !position->stops && position->cubic_ticks == 0 && profile_arrived(&position->profile, position->target);
    status->arrived = position->sequence;
    status->reference_ended = arrived;
    const int64_t left = sample->count != 0 ? error_of_count(position, sample, position->profile.start.x) : error;
    status->in_position = arrived && left <= parameters->window && left >= -parameters->window;
}

/* An inertia has become known, larger than the one of the limits so far, with which the reference has left the rotor
 * behind: it goes on from there, with limits that the torque can keep. */
COLD NOINLINE static void follow_inertia(position_t *position, const position_command_t *command,
                                         const position_sample_t *sample) {
    const int32_t known_q14 = position->inertia_ratio_q14, ratio_q14 = command->inertia_ratio_q14;
    if (ratio_q14 > known_q14 + known_q14 / 8 && sample->at_torque_limit && position->homing == POSITION_HOMING_IDLE) {
        begin_here(position, sample);
    }
    position->inertia_ratio_q14 = ratio_q14;
}

static bool acknowledged(const position_t *position, const position_set_point_t *set_point, bool begins) {
    const bool comes = begins || (set_point->acknowledges && set_point->sequence != position->sequence);
    return comes && set_point->order == POSITION_ORDER_HALT;
}

/* The order decides where the reference goes from this tick on. */
COLD NOINLINE static void decide(position_t *position, const position_command_t *command,
                                 const position_sample_t *sample) {
    const position_set_point_t *set_point = &command->set_point;
    const bool begins = set_point->order != position->order;
    position->status.limited = position->status.limited && !begins;
    if (begins && position->homing != POSITION_HOMING_IDLE) {
        end_homing(position, false);
    }
    if (acknowledged(position, set_point, begins)) {
        position->status.following_error = false;
    }
    if (position->status.following_error || set_point->order == POSITION_ORDER_HALT) {
        stop(position, &command->limits);
    } else if (set_point->order == POSITION_ORDER_CYCLIC) {
        follow_targets(position, command, begins);
    } else if (set_point->order == POSITION_ORDER_HOME) {
        home(position, command, sample, begins);
    } else if (begins || set_point->sequence != position->sequence) {
        go_to(position, command, to_profile(limited(set_point->target)));
    } else {
        keep_within(position, command);
    }
    if (set_point->order != POSITION_ORDER_CYCLIC || position->status.following_error) {
        position->cubic_ticks = 0;
    }
    position->order = set_point->order;
    position->sequence = position->status.sequence = set_point->sequence;
    position->status.homing = position->homing != POSITION_HOMING_IDLE;
}

COLD NOINLINE static void tick(const position_law_t *parameters, position_t *position,
                               const position_command_t *command, const position_sample_t *sample) {
    profile_t *profile = &position->profile;
    if (position->cubic_ticks > 0) {
        const int64_t q = profile->q;
        profile_tick(profile);
        profile->q = q;
        position->cubic_ticks--;
        if (position->cubic_ticks == 0) {
            profile->start.x = position->target;
            profile->start.a = profile->q = 0; /* of the cubic; a profile begins without */
        }
    } else {
        profile_tick(profile);
    }
    check_following(parameters, position, sample);
    follow_inertia(position, command, sample);
    decide(position, command, sample);
    profile->end = profile_advance(&profile->start, profile->q);
}

/* The order's limits with the speed of a homing. */
static profile_limits_t limits_of(const position_law_t *parameters, const position_t *position,
                                  const position_command_t *command) {
    profile_limits_t limits = command->limits;
    if (position->homing != POSITION_HOMING_IDLE && limits.speed > parameters->homing_speed) {
        limits.speed = parameters->homing_speed;
    }
    return limits;
}

static position_output_t output(const position_law_t *parameters, position_t *position,
                                const position_command_t *command, const position_sample_t *sample) {
    position_status_t *status = &position->status;
    const uint32_t part_q16 = (uint32_t)((uint64_t)position->phase * parameters->part_per_period_q32 >> 16);
    const profile_state_t state = profile_at(&position->profile, fixed_min_u32(part_q16, UINT16_MAX));
    const bool rests = state.v == 0 && state.a == 0;
    const int64_t error = sample->count != 0 && rests ? error_of_count(position, sample, state.x)
                                                      : state.x - to_profile(status->position);
    const bool cyclic = position->order == POSITION_ORDER_CYCLIC && !position->stops;
    status->reference = state.x >> TO_PROFILE;
    status->error = fixed_saturate(error >> TO_PROFILE);
    status->speed_reference_q22 = fixed_saturate(profile_scale(state.v, parameters->speed_of));
    const int64_t bounded = fixed_clamp_64(error, -(INT64_C(1) << 56), INT64_C(1) << 56);
    const int32_t correction_q22 = fixed_saturate(profile_scale(bounded, parameters->gain));
    const int32_t torque_q24 = fixed_saturate(profile_scale(state.a, parameters->torque_of));
    return (position_output_t){
        .speed_q22 = fixed_add(fixed_add(status->speed_reference_q22, correction_q22),
                               cyclic ? command->set_point.speed_offset_q22 : 0),
        .torque_q24 = fixed_add(torque_q24, cyclic ? command->set_point.torque_offset_q24 : 0),
    };
}

position_output_t position_step(const position_law_t *parameters, position_t *position,
                                const position_command_t *command, const position_sample_t *sample) {
    position_status_t *status = &position->status;
    count(position, sample->encoder_angle, sample->angle);
    if (!status->active) {
        status->active = true;
        begin_here(position, sample);
        position->order = POSITION_ORDER_HALT; /* whatever comes begins */
        decide(position, command, sample);
        position->profile.end = profile_advance(&position->profile.start, position->profile.q);
    }
    position->phase += sample->periods;
    if (position->phase >= parameters->periods_per_tick) {
        position->phase -= parameters->periods_per_tick;
        if (position->phase >= parameters->periods_per_tick) {
            position->phase = 0; /* skipped periods; the reference waits */
        }
        tick(parameters, position, command, sample);
    }
    if (position->cubic_ticks == 0) {
        const profile_limits_t limits = limits_of(parameters, position, command);
        profile_search(&limits, &position->profile, position->target);
    }
    return output(parameters, position, command, sample);
}
