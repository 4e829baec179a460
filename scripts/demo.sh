#!/usr/bin/env bash
# Makes a scene, reconstructs it and compares the depth maps with the exact ones.
# usage: demo.sh PROGRAM [WEIGHTS]
set -euo pipefail
program=$1
weights=$2
mkdir -p demo
# Without WEIGHTS, those that come with the program are used.
if [ -n "$weights" ] && [ "${weights%.safetensors}" = "$weights" ]; then
    "$program" weights import "$weights" -o demo/weights.safetensors
    weights=demo/weights.safetensors
fi
if [ ! -e demo/scene/sparse ]; then
    # What an interrupted run left of it.
    rm -rf demo/scene
    "$program" synth demo/scene
fi
"$program" reconstruct demo/scene -o demo/out ${weights:+--weights "$weights"}
"$program" evaluate depth demo/out demo/scene/depth_gt
echo
echo "look at demo/out/report.html, demo/out/cloud.ply and demo/out/preview/"
