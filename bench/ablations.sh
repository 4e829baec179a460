#!/usr/bin/env bash
# The ablations of the paper's section 5.4 on our own terms: the same samples and steps for each network, then the
# errors of all on generated courtyards, with 2, 3 and 5 views.
# usage: ablations.sh PROGRAM OUT [STEPS]; run again, it goes on where it stopped.
set -euo pipefail
program=$1
out=$2
steps=${3:-800}
mkdir -p "$out"

configuration() { # NETWORK
    cat <<EOF
seed = 7
steps = $steps
[network]
$1
[samples]
sizes = [[160, 128]]
views = [3]
depths = [16, 48]
[optimizer]
warmup = 50
statistics_momentum = 0.02
freeze_statistics_at = $((steps * 3 / 4))
average_decay = 0.99
[progress]
log_every = 50
validate_every = 1000000
EOF
}

declare -A networks=(
    [paper]='refinement = "none"'
    [mean]='metric = "mean"'
    [single-layer]='features = "single-layer"'
    [refined]='refinement = "paper"'
)
for name in paper mean single-layer refined; do
    configuration "${networks[$name]}" >"$out/$name.toml"
    "$program" train "$out/$name.toml" -o "$out/$name" 2>"$out/$name.log" >&2 || { cat "$out/$name.log"; exit 1; }
done
for seed in 1 2; do
    "$program" synth "$out/courtyard-$seed" --seed "$seed" >&2
done

measure() { # WEIGHTS VIEWS
    for seed in 1 2; do
        result="$out/results/$1-$2-$seed"
        # An empty cloud of a bad network is a result, too; depth maps are what is measured.
        "$program" reconstruct "$out/courtyard-$seed" -o "$result" --weights "$out/$1/weights.safetensors" \
            --views "$2" >/dev/null 2>&1 || true
        "$program" evaluate depth "$result" "$out/courtyard-$seed/depth_gt" --json
    done | python3 -c '
import json, sys
means = [json.loads(line)["mean"]["all"] for line in sys.stdin]
def mean(key):
    return sum(m[key] for m in means) / len(means)
print("| %s | %s | %.2f %% | %.1f %% | %.1f %% |" % (
    sys.argv[1], sys.argv[2], 100 * mean("median_relative"), 100 * mean("within_1_interval"),
    100 * mean("within_3_intervals")))' "$1" "$2"
}

echo "| network | views | median error | below 1 interval | below 3 intervals |"
echo "| --- | --- | --- | --- | --- |"
for name in paper mean single-layer refined; do
    measure "$name" 3
done
measure paper 2
measure paper 5
