#!/usr/bin/env bash
# Runs the tests that take too long for every test run. One line each: package, test, what it does.
set -uo pipefail
cd "$(dirname "$0")/.."
status=0
cargo build --workspace || exit 1
PLANESWEEP_PROGRAM="${CARGO_TARGET_DIR:-$PWD/target}/debug/planesweep"
export PLANESWEEP_PROGRAM
slow() {
    echo "== $2: $3"
    cargo test --quiet -p "$1" -- --ignored --exact --nocapture "$2" || status=1
}

slow planesweep-scene all_photographs_of_shared_scenes_go_in_and_out_of_every_format \
    "every photograph of every shared scene in every format, some of them resampled: minutes"
slow planesweep-tests two_thousand_maps_stay_within_512_mib \
    "2 000 depth maps of 480x264 fused within 512 MiB: minutes, and 6 GB of disk"
slow planesweep-tests a_cloud_of_a_hundred_million_points_is_streamed \
    "10^8 points streamed to disk: minutes, and 6 GB of disk"

exit "$status"
