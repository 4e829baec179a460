#!/usr/bin/env bash
# Networks and ways to train them, measured on our own terms: the same samples and steps for each, then the errors of
# all on generated courtyards.
#   paper    the ablations of the paper's section 5.4, tested with 2, 3 and 5 views
#   choices  what the paper leaves open: sampling, normalisation, views, weights of the loss; each changes one thing of
#            `base`, in which pixels without a surface count
# usage: ablations.sh PROGRAM OUT [STEPS] [paper|choices]; run again, it goes on where it stopped.
set -euo pipefail
program=$1
out=$2
steps=${3:-800}
table=${4:-paper}
mkdir -p "$out"

train() { # NAME SETTING...
    local name=$1
    shift
    {
        cat <<EOF
seed = 7
steps = $steps
samples.sizes = [[160, 128]]
samples.depths = [16, 48]
optimizer.warmup = 50
optimizer.statistics_momentum = 0.02
optimizer.freeze_statistics_at = $((steps * 3 / 4))
optimizer.average_decay = 0.99
progress.log_every = 50
progress.validation_samples = 48
progress.validate_every = 1000000
EOF
        printf '%s\n' "$@"
    } >"$out/$name.toml"
    "$program" train "$out/$name.toml" -o "$out/$name" 2>"$out/$name.log" >&2 || { cat "$out/$name.log"; exit 1; }
}

measure() { # NAME SAMPLING VIEWS
    for seed in 1 2; do
        result="$out/results/$1-$2-$3-$seed"
        # An empty cloud of a bad network is a result, too; depth maps are what is measured.
        "$program" reconstruct "$out/courtyard-$seed" -o "$result" --weights "$out/$1/weights.safetensors" \
            --sampling "$2" --views "$3" >/dev/null 2>&1 || true
        "$program" evaluate depth "$result" "$out/courtyard-$seed/depth_gt" --json
    done | python3 -c '
import json, sys
name, sampling, views, validations = sys.argv[1:]
means = [json.loads(line)["mean"]["all"] for line in sys.stdin]
def mean(key):
    return sum(m[key] for m in means) / len(means)
absent = float(open(validations).read().split()[-1].split(",")[-1])
print("| %s | %s | %s | %.2f %% | %.1f %% | %.1f %% | %.0f %% |" % (
    name, sampling, views, 100 * mean("median_relative"), 100 * mean("within_1_interval"),
    100 * mean("within_3_intervals"), 100 * absent))' "$1" "$2" "$3" "$out/$1/validation.csv"
}

for seed in 1 2; do
    rm -rf "$out/courtyard-$seed"
    "$program" synth "$out/courtyard-$seed" --seed "$seed" >&2
done
if [ "$table" = paper ]; then
    train paper
    train mean 'network.metric = "mean"'
    train single-layer 'network.features = "single-layer"'
    train refined 'network.refinement = "paper"'
else
    train base 'loss.absent_weight = 1.0'
    train uniform 'loss.absent_weight = 1.0' 'samples.inverse_share = 0.0'
    train inverse 'loss.absent_weight = 1.0' 'samples.inverse_share = 1.0'
    train unit-range 'loss.absent_weight = 1.0' 'network.normalization = "unit-range"'
    train two-views 'loss.absent_weight = 1.0' 'samples.views = [2]'
    train five-views 'loss.absent_weight = 1.0' 'samples.views = [5]'
    train sky-teaches-nothing
    train clamp-5 'loss.absent_weight = 1.0' 'loss.clamp = 5.0'
    train refined-quarter 'loss.absent_weight = 1.0' 'network.refinement = "paper"' 'loss.refined_weight = 0.25'
fi

echo "| network | sampling | views | median error | below 1 interval | below 3 intervals | no surface, yet confident |"
echo "| --- | --- | --- | --- | --- | --- | --- |"
if [ "$table" = paper ]; then
    for name in paper mean single-layer refined; do
        measure "$name" auto 3
    done
    measure paper auto 2
    measure paper auto 5
else
    for name in base uniform inverse; do
        measure "$name" uniform 3
        measure "$name" inverse 3
    done
    for name in unit-range two-views five-views sky-teaches-nothing clamp-5 refined-quarter; do
        measure "$name" inverse 3
    done
    for name in base five-views; do
        measure "$name" inverse 5
    done
fi
