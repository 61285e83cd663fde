#!/bin/bash
# Everything behind docs/table.md, from nothing. Each command is shown as it runs, and the whole time at the end.
#   DATA=/path/to/nerf_mic docs/table/make_table.sh [OUT] [STEPS]
# DATA: a folder like NeRF's synthetic `mic` (train/, val/, transforms_*.json); without it the twins are left out.
# Given again after an interruption, it goes on where it was.
set -euo pipefail
OUT=${1:-runs/table}; STEPS=${2:-1000}; JOBS=${JOBS:-2}; SIZE=${SIZE:-160x160}; EVERY=${EVERY:-4}
SHARP=${SHARP:-3000}; FAST=${FAST:-2000}  # steps of the two sharp models behind the twins
SCENES=${SCENES:-"leaves glossy fabric"}; HERE=docs/table
ROWS=${ROWS:-plain,plain@first,deblur,edi,e2-5x,e2-2x,spikenerf-5x,spikenerf,spikenerf@first,average,bad,ours,oracle}
run() { echo "+ $*"; "$@"; }
once() { [ -e "$1" ] || { shift; run "$@"; }; }
mkdir -p "$OUT"; files=(); more=()

# 1. Simulated scenes: spikes and events of the same light.
for s in $SCENES; do
  once "$OUT/$s.h5" spikerig sim capture $HERE/$s.toml -o "$OUT/$s.h5" --workers "$JOBS"
  files+=("$OUT/$s.h5")
done

# 2. Twins of somebody else's pictures, by two renderers: splats, and a NeRF (splats trained on splat renders flatter).
if [ -n "${DATA:-}" ]; then
  poses() { echo --transforms "$DATA/transforms_$1.json" --background white --size "$SIZE"; }
  mkdir -p "$OUT/some"
  for k in $(seq 0 "$EVERY" 99); do cp -n "$DATA/train/r_$k.png" "$OUT/some/"; done
  once "$OUT/mic.h5" spikerig data build --rgb "$DATA/train" $(poses train) -o "$OUT/mic.h5"
  once "$OUT/val.h5" spikerig data build --rgb "$DATA/val" $(poses val) --test-every 1 -o "$OUT/val.h5"
  once "$OUT/split.h5" spikerig data build --rgb "$OUT/some" $(poses train) --skip-unmatched \
    --test-every $((5 * EVERY)) -o "$OUT/split.h5"
  for field in splat nerf-fast; do
    twin=mic-$field; steps=$SHARP; [ $field = splat ] || steps=$FAST
    once "$OUT/$twin.h5" spikerig train fit "$OUT/mic.h5" --method plain --preset draft --field $field --steps "$steps" \
      --background white --eval-every 0 --resume -o "$OUT/sharp-$field"
    once "$OUT/$twin.h5" spikerig train score "$OUT/sharp-$field" "$OUT/val.h5"
    once "$OUT/$twin.h5" spikerig train render "$OUT/sharp-$field" --scene "$OUT/split.h5" --path shake --format exr \
      --shake-px 6 10 --seed 0 --force -o "$OUT/shaken-$field"
    once "$OUT/$twin.h5" spikerig sim frames "$OUT/shaken-$field" --settings $HERE/twin.toml --workers "$JOBS" -o "$OUT/$twin.h5"
    files+=("$OUT/$twin.h5"); more+=(--score-on "$twin=$OUT/val.h5" --set "$twin:background=white")
  done
fi

# 3. The table, and SpikeNeRF with as many renders as E2NeRF 5x: what equal dB cost.
code=0
run spikerig train table "${files[@]}" --methods $ROWS --steps "$STEPS" --jobs "$JOBS" "${more[@]}" --resume \
  -o "$OUT/all" || code=$?
run spikerig train table "${files[@]:0:3}" --methods e2-5x,spikenerf --steps "$STEPS" --jobs "$JOBS" \
  --set spikenerf:steps=$((5 * STEPS)) --resume -o "$OUT/cost" || code=$?
echo "$((SECONDS / 60)) min $((SECONDS % 60)) s in all; $OUT/all/table.md, $OUT/cost/table.md"
exit $code
