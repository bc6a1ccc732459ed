"""Random faults by seed: worlds, their judgement, and what is done with failures."""
