#!/bin/sh
# A sweep: five observer bandwidths on two machines, three seeds of the sensors' noise; the table is out/sweep/sweep.csv.
# SALIENT is the command: tools/salient in a clone, salient with an installed package.
exec ${SALIENT:-salient} sweep load_step_150 --controller salient \
    --machine saturating --machine linear_cosine \
    --set observer_bandwidth_rad_s=1200:2800:5 --set current_noise_A=0.05 --seeds 3 "$@"
