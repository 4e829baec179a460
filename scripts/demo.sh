#!/usr/bin/env bash
# Makes a scene, reconstructs it and compares the depth maps with the exact ones.
# usage: demo.sh PROGRAM WEIGHTS
set -euo pipefail
program=$1
weights=$2
if [ -z "$weights" ]; then
    echo "The program has no weights of its own yet. Give the file of a trained MVSNet:" >&2
    echo "  make demo WEIGHTS=model.ckpt     (a checkpoint of the public PyTorch MVSNet)" >&2
    echo "  make demo WEIGHTS=FILE.safetensors   (what 'planesweep weights import' wrote)" >&2
    exit 2
fi
mkdir -p demo
if [ "${weights%.safetensors}" = "$weights" ]; then
    "$program" weights import "$weights" -o demo/weights.safetensors
    weights=demo/weights.safetensors
fi
if [ ! -e demo/scene/sparse ]; then
    "$program" synth demo/scene
fi
"$program" reconstruct demo/scene -o demo/out --weights "$weights"
"$program" evaluate depth demo/out demo/scene/depth_gt
echo
echo "look at demo/out/report.html, demo/out/cloud.ply and demo/out/preview/"
