#!/usr/bin/env bash
# Measure what needs a GPU, in order of importance: see docs/gpu.md.
#   scripts/gpu.sh MTT.txt outputs/gpu
# The same on a CPU, small, to try the commands: DEVICE=cpu BATCH=2 STEPS=2 REPEATS=1 scripts/gpu.sh MTT.txt outputs/gpu
set -euo pipefail
timelines=${1:?usage: scripts/gpu.sh TIMELINES OUTPUT} output=${2:?usage: scripts/gpu.sh TIMELINES OUTPUT}
device=${DEVICE:-cuda} batch=${BATCH:-500} steps=${STEPS:-50} repeats=${REPEATS:-3}
mkdir -p "$output"

run() {  # name, command: its output is kept, under its name, once it has ended
  local name=$1
  shift
  echo "$name: stmc $*"
  python -m stmc "$@" device="$device" | tee "$output/.$name.txt"
  mv "$output/.$name.txt" "$output/$name.txt"
}

measure=(benchmark "timelines=$timelines" "baselines=[]" "steps=$steps" "repeats=$repeats" published=true roofline=true)
run parity benchmark "timelines=$timelines" "baselines=[]" "steps=$steps" repeats=1 batch=$((batch < 8 ? batch : 8))
run bf16 "${measure[@]}" batch="$batch" precision=bf16
run fp32 "${measure[@]}" batch="$batch"
run length benchmark_length "steps=$steps" "repeats=$repeats" "seconds=[10,60,600]" output="$output/length"
run sample sample "timeline=$timelines" "steps=$steps" "batch=$batch" precision=bf16 "formats=[npz]" output="$output/motions"
