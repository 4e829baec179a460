#!/usr/bin/env bash
# Runs the tests that take too long for every test run. One line each: package, test, what it does.
set -uo pipefail
cd "$(dirname "$0")/.."
status=0
slow() {
    echo "== $2: $3"
    cargo test --quiet -p "$1" -- --ignored --exact --nocapture "$2" || status=1
}

slow planesweep-scene all_photographs_of_shared_scenes_go_in_and_out_of_every_format \
    "every photograph of every shared scene in every format, some of them resampled: minutes"

exit "$status"
