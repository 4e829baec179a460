#!/usr/bin/env bash
# Runs all tests, then counts and names the skipped ones.
#
# A test that needs something this machine lacks prints "SKIPPED <test>: <what>" and passes.
set -uo pipefail
cd "$(dirname "$0")/.."

# Everything at once: packages built one by one would build their dependencies again, with other features.
cargo build --workspace --all-targets || exit 1
# What several suites start.
PLANESWEEP_PROGRAM="${CARGO_TARGET_DIR:-$PWD/target}/debug/planesweep"
export PLANESWEEP_PROGRAM
if command -v cargo-nextest >/dev/null; then
    # nextest runs no documentation tests.
    cargo test --workspace --doc --quiet || exit 1
    log=target/nextest/default/junit.xml
    rm -f "$log"
    cargo nextest run --workspace
    status=$?
    count() { grep -o "<testsuites [^>]*" "$log" | grep -o " $1=\"[0-9]*\"" | tr -dc 0-9; }
    failed=$(($(count failures) + $(count errors)))
    passed=$(($(count tests) - failed))
else
    mkdir -p target
    log=target/test.log
    cargo test --workspace -- --nocapture 2>&1 | tee "$log"
    status=${PIPESTATUS[0]}
    count() { grep -o "test result: .*" "$log" | grep -o "[0-9]* $1" | awk '{n += $1} END {print n + 0}'; }
    failed=$(count failed)
    passed=$(count passed)
fi

skipped=$(grep -o 'SKIPPED .*' "$log" | sort -u)
names=0
if [ -n "$skipped" ]; then
    names=$(printf '%s\n' "$skipped" | cut -d: -f1 | sort -u | wc -l)
    echo
    echo "skipped for want of data or tools:"
    printf '%s\n' "$skipped" | sed 's/SKIPPED /  /'
fi
echo
echo "$((passed - names)) passed, $failed failed, $names skipped"
exit "$status"
