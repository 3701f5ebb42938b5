#!/bin/bash
# Trains on a lent machine with an accelerator, its own jax and no registry, by calls that follow each other:
#   experiments/train_on_device.sh take PARTS             install PARTS/*.whl, unpack PARTS/*.tar.* into outputs/packs
#   experiments/train_on_device.sh start COUNT NAME ...   train configs in the background, so many at once
#   experiments/train_on_device.sh look                   how far they are, and what went wrong
#   experiments/train_on_device.sh steps NAME NUMBER      end a config's run after so many steps in all, its rate with it
#   experiments/train_on_device.sh stop OUTPUT            stop all, with everything saved, and pack the runs
# All happens in a copy of the checkout, KMN_DEVICE (/tmp/kmn), as the next call may replace the checkout. PARTS holds
# what one call can carry: wheels of what the machine lacks (grain, array-record, portpicker, more-itertools, tyro,
# docstring-parser, typeguard, shtab) and a part of the pack, such as of
#   (cd outputs/packs && find surfels/objects -name '[A-L]*.safetensors' | tar cJ -T - -f PARTS/pack.tar.xz)
# and the manifest in one of them. What `take` unpacks stays: a pack may come in several calls. OUTPUT gets the runs as
# one tar file in pieces of 15.5 MB, of the first config with its newest checkpoint. Compiling a step takes a minute of
# sixteen cores and longer beside others, so that few runs at once keep the device busy. Leave XLA's autotuning on:
# without it products for gradients take most of a step.
set -euo pipefail
state=${KMN_DEVICE:-/tmp/kmn}
here=$(cd "$(dirname "$0")/.." && pwd)
what=$1
shift
mkdir -p "$state/logs" "$state/runs" "$state/site"
export PYTHONPATH=$state/site PYTHONUNBUFFERED=1 XLA_PYTHON_CLIENT_PREALLOCATE=false
export JAX_COMPILATION_CACHE_DIR=$state/compiled

train() { # NAME [--field value ...]
  python3 -m experiments.train "$1" --folder "$state/runs/$1" --resume "${@:2}" >>"$state/logs/$1.log" 2>&1 ||
    echo "$1 did not end well" >>"$state/logs/$1.log"
}

# Stop runs between two steps and wait until all is saved: of one config, or of all.
end() {
  pkill -TERM -f "experiments.train ${1:-.*} --folder $state" || true
  while pgrep -f "experiments.train ${1:-.*} --folder $state" >/dev/null; do sleep 0.2; done
}

case $what in
take)
  [ -d "$state/tree" ] || cp -r "$here" "$state/tree"
  if compgen -G "$1/*.whl" >/dev/null; then
    python3 -m pip install -q --no-index --no-deps --no-compile --no-cache-dir --upgrade --target "$state/site" "$1"/*.whl
  fi
  mkdir -p "$state/tree/outputs/packs"
  for part in "$1"/*.tar.*; do tar x -C "$state/tree/outputs/packs" -f "$part"; done
  ;;
start)
  export -f train
  export state
  printf '%s\n' "$2" >"$state/first"
  cd "$state/tree"
  printf '%s\n' "${@:2}" | setsid nohup xargs -P "$1" -I{} bash -c 'train {}' >/dev/null 2>&1 &
  echo $! >"$state/queue"
  ;;
look)
  for run in "$state"/runs/*/; do
    echo "$(basename "$run"): $(tail -qn 1 "$run/metrics.jsonl" 2>/dev/null | cut -c 1-240)"
    tr '\r' '\n' <"$state/logs/$(basename "$run").log" | grep -E "did not end well|Error|^done|^stopped" || true
  done
  ;;
steps)
  end "$1"
  cd "$state/tree"
  export -f train
  export state
  setsid nohup bash -c "train $1 --num-steps $2" >/dev/null 2>&1 &
  ;;
stop)
  kill "$(cat "$state/queue")" 2>/dev/null || true
  end
  mkdir -p "$1"
  cd "$state"
  first=$(cat first)
  { find runs logs -type f ! -path '*/checkpoints/*'; find "$(ls -dt runs/"$first"/checkpoints/step-* | head -n 1)" -type f; } |
    tar c -T - | split -b 15500000 - "$1/runs.tar."
  ;;
*)
  sed -n 2,8p "$0"
  exit 2
  ;;
esac
