#!/usr/bin/env bash
# On a machine with a GPU and CUDA's toolkit: builds with `--features cuda` (the kernels take up to an hour), plays all strategies on the
# GPU and on the CPU in f32, and prints the times of the ego's stages and the scores of both. A copy of features is `to_host`; without
# synchronising first it would be `synchronisation` longer. Nothing here trains: training runs on the CPU.
#
# Usage: tools/measure_cuda.sh [GRAPH:MODEL...; default: all methods in `lite` and `full`]
# DEVICES="cuda cpu" are compared; DEVICES=cpu tries the script where there is no GPU. RATE: seconds of log in a second, 0.2.
set -euo pipefail
cd "$(dirname "$0")/.."

devices=${DEVICES:-cuda cpu}
out=target/realo/cuda
features=()
[[ $devices == *cuda* ]] && features=(--features cuda)
cargo build --release "${features[@]}" -p realo
cargo build --release --bin realo-lab

log=$out/log.mcap
mkdir -p "$out"
[ -e "$log" ] || target/release/realo-lab simulate --scenario mixed --place 904 --seed 904 --seconds 6 -o "$log"

runs=("$@")
if [ $# -eq 0 ]; then
  runs=(no_fusion:lite attfuse:lite-fcooper attfuse:lite-attfuse v2xvit:lite-v2xvit
    no_fusion:full attfuse:full-fcooper attfuse:full-attfuse attfuse:full-v2vnet v2xvit:full-v2xvit)
fi
for device in $devices; do
  for run in "${runs[@]}"; do
    # Scores are of runs offline, times of runs in realtime, slow enough for the largest networks.
    for mode in offline realtime; do
      folder=$out/$device/${run/:/-}/$mode
      mkdir -p "$folder"
      options=(--offline)
      [ $mode = realtime ] && options=(--rate "${RATE:-0.2}")
      target/release/realo run "${run%%:*}" --model "${run#*:}" --device "$device" --precision f32 --ego cav1 --agents cav1,cav2 \
        --log "$log" --out "$folder" "${options[@]}" > "$folder.txt" 2>&1 || echo "$run on $device failed: see $folder.txt"
    done
  done
done

python3 - "$out" <<'EOF'
import json, pathlib, sys

print(f"{'device, strategy and model':40} {'mAP@0.5':>8}  median ms of each step of a call")
for folder in sorted(pathlib.Path(sys.argv[1]).glob("*/*")):
    offline, realtime = folder / "offline/result.json", folder / "realtime/timing.json"
    if not (offline.exists() and realtime.exists()):
        continue
    score = json.loads(offline.read_text())["accuracy"]["sorted"]["mAP"].get("0.5")
    steps = json.loads(realtime.read_text())["steps_ms"]
    words = []
    for node, known in sorted(steps.items()):
        if not node.startswith("others"):
            words += [f"{node} {step} {spread['p50']:.2f}" for step, spread in known.items()]
    print(f"{str(folder.relative_to(sys.argv[1])):40} {'–' if score is None else f'{score:.3f}':>8}  {', '.join(words)}")
EOF
