/* Words of the proofs by bounded model checking: python -m salient.experiments.proofs. A proof is a function prove_NAME
 * whose parameters take every value that its assumptions leave; CBMC looks for values that break a claim, or for which
 * the behaviour of the code is undefined. */
#ifndef PROOFS_PROOF_H
#define PROOFS_PROOF_H

#include <stdbool.h>
#include <stdint.h>

/* A range of the arguments; a comment names who keeps it. */
#define ASSUME(condition) __CPROVER_assume(condition)

#define CLAIM(condition) __CPROVER_assert(condition, #condition)

#define IMPLIES(condition, consequence) (!(condition) || (consequence))

#endif
