#!/bin/sh
# bonsai with gsplat on a GPU: what the CPU of benchmarks/README.md and docs/results cannot show.
#
#     sh benchmarks/gpu/bonsai.sh PATH/TO/bonsai OUTPUT
#
# Two benchmarks, both resumable: 7,000 steps of four kinds of seeds, twice each; then 30,000 steps of
# three, twice each, whose SfM row stands beside the paper's 32.29 dB. (Theirs are images_2 of the data
# set; copies of another size differ by up to half a decibel.) Some hours on one H100, by a rough model.
# The second also has 3DGS's own conventions, so that the trainer itself is compared with the paper's.
set -eu
scene=$1 output=$2

splatseed bench --scenes "$scene" --methods sfm mls linear triangle --ratios 8 --strategies default \
    --repeats 2 --max-steps 7000 --backend cuda -o "$output/bonsai_7000"
splatseed bench report "$output/bonsai_7000"

splatseed bench --scenes "$scene" --methods sfm mls linear --ratios 8 \
    --strategies default default-3dgs --repeats 2 --max-steps 30000 --backend cuda -o "$output/bonsai_30000"
splatseed bench report "$output/bonsai_30000"
