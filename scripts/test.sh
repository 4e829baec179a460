#!/usr/bin/env bash
# Runs all tests and then counts and names the skipped ones.
#
# A test that needs something this machine lacks prints "SKIPPED <test>: <what>" and passes.
set -uo pipefail
cd "$(dirname "$0")/.."
mkdir -p target

# The program itself is what several suites start.
cargo build -p planesweep || exit 1
if command -v cargo-nextest >/dev/null; then
    log=${CARGO_TARGET_DIR:-target}/nextest/default/junit.xml
    rm -f "$log"
    cargo nextest run --workspace
    status=$?
    # nextest runs no documentation tests.
    if [ "$status" -eq 0 ]; then
        cargo test --workspace --doc --quiet
        status=$?
    fi
else
    log=target/test.log
    cargo test --workspace -- --nocapture 2>&1 | tee "$log"
    status=${PIPESTATUS[0]}
fi

skipped=$(grep -o 'SKIPPED .*' "$log" | sort -u)
echo
if [ -n "$skipped" ]; then
    echo "skipped tests: $(printf '%s\n' "$skipped" | wc -l)"
    printf '  %s\n' "$skipped" | sed 's/SKIPPED //'
else
    echo "skipped tests: 0"
fi
exit "$status"
