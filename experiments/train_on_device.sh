#!/bin/bash
# Trains on a lent machine with an accelerator, its own jax and no registry, by calls that follow each other:
#   experiments/train_on_device.sh take PARTS             install PARTS/*.whl, unpack PARTS/*.tar.* into outputs/packs
#   experiments/train_on_device.sh start COUNT NAME ...   train configs in the background, so many at once; one call
#   experiments/train_on_device.sh look [OUTPUT]          how far they are, and what went wrong; pack the runs so far
#   experiments/train_on_device.sh steps NAME NUMBER      let a run that has begun end after so many steps in all
#   experiments/train_on_device.sh stop OUTPUT            stop all, with everything saved, and pack the runs
# All happens in a copy of the checkout, KMN_DEVICE (/tmp/kmn), as the next call may replace the checkout. PARTS holds
# what one call can carry: wheels of what the machine lacks (grain, array-record, portpicker, more-itertools, tyro,
# docstring-parser, typeguard, shtab) and a part of the pack, made in outputs/packs by commands such as
#   find surfels/objects -name '[A-L]*.safetensors' | tar cJ -T - -f "$PARTS/pack.tar.xz"
# and the manifest with one of them. What `take` unpacks stays: a pack may come in several calls. Visibility bits are too
# large to carry, so that scenes of a pack need --examples.visibility splat in `train` below; worlds need no bits.
# OUTPUT gets the runs as one tar file in pieces of 15.5 MB, after `stop` that of the first config with its newest
# checkpoint. Let every `look` pack: a machine may be gone by the next call, and all that did not come back with it.
# Compiling a step takes a minute of sixteen cores and longer beside others, seven runs at once nearly seven minutes, so
# that few runs at once keep the device busy. Leave XLA's autotuning on: without it products for gradients take most of a
# step. Call `stop` and `steps` from a file: they end every process on whose command line experiments.train stands
# before --folder and that place, such as a shell that was given a search for it.
set -euo pipefail
state=$(realpath -m "${KMN_DEVICE:-/tmp/kmn}")
here=$(cd "$(dirname "$0")/.." && pwd)
what=${1:-}
shift || true
mkdir -p "$state/logs" "$state/runs" "$state/site"
export PYTHONPATH=$state/site PYTHONUNBUFFERED=1 XLA_PYTHON_CLIENT_PREALLOCATE=false
export JAX_COMPILATION_CACHE_DIR=$state/compiled

train() { # NAME [--field value ...]
  python3 -m experiments.train "$1" --folder "$state/runs/$1" --resume "${@:2}" >>"$state/logs/$1.log" 2>&1 ||
    echo "$1 did not end well" >>"$state/logs/$1.log"
}

# Stop runs between two steps, also such as a benchmark has stopped, and wait until all is saved: of one config, or of
# all. A run that compiles hears it late; after WAIT seconds it is killed, and loses what it has done since it last saved.
end() {
  local runs="experiments.train ${1:-.*} --folder $state" left=$((5 * ${WAIT:-120}))
  pkill -TERM -f "$runs" || true
  pkill -CONT -f "$runs" || true
  while pgrep -f "$runs" >/dev/null && ((left-- > 0)); do sleep 0.2; done
  pkill -KILL -f "$runs" || true
}

# Pack runs and logs into a folder, with the files that standard input names.
pack() { # FOLDER
  mkdir -p "$1"
  rm -f "$1"/runs.tar.*
  { find runs logs -type f ! -path '*/checkpoints/*' ! -name '.*' && cat; } | { tar c -T - || [ $? = 1 ]; } | # 1: a file grew
    split -b 15500000 - "$1/runs.tar."
}

case $what in
take)
  [ -d "$state/tree" ] || cp -r "$here" "$state/tree"
  if compgen -G "$1/*.whl" >/dev/null; then
    python3 -m pip install -q --no-index --no-deps --no-compile --no-cache-dir --upgrade --target "$state/site" "$1"/*.whl
  fi
  mkdir -p "$state/tree/outputs/packs"
  for part in "$1"/*.tar.*; do
    [ ! -e "$part" ] || tar x -C "$state/tree/outputs/packs" -f "$part"
  done
  ;;
start)
  if [ -e "$state/queue" ]; then
    echo "runs were started before: name all of them in one call, or stop them" >&2
    exit 2
  fi
  export -f train
  export state
  printf '%s\n' "$2" >"$state/first"
  cd "$state/tree"
  printf '%s\n' "${@:2}" | setsid nohup xargs -P "$1" -I{} bash -c 'train {}' >/dev/null 2>&1 &
  echo $! >"$state/queue"
  ;;
look)
  for log in "$state"/logs/*.log; do
    name=$(basename "$log" .log)
    echo "$name: $(tail -qn 1 "$state/runs/$name/metrics.jsonl" 2>/dev/null | cut -c 1-240)"
    tr '\r' '\n' <"$log" | grep -E "did not end well|[Ee]rror|^train:|^done|^stopped" || true
  done
  if [ -n "${1:-}" ]; then
    output=$(realpath -m "$1")
    cd "$state"
    pack "$output" </dev/null
  fi
  ;;
steps)
  end "$1"
  cd "$state/tree"
  export -f train
  export state
  setsid nohup bash -c "train $1 --num-steps $2" >/dev/null 2>&1 &
  ;;
stop)
  output=$(realpath -m "$1")
  if [ -e "$state/queue" ]; then kill "$(cat "$state/queue")" 2>/dev/null || true; fi
  end
  rm -f "$state/queue"
  cd "$state"
  newest=$(find runs/"$(cat first 2>/dev/null)"/checkpoints -maxdepth 1 -name 'step-*' -printf '%T@ %p\n' 2>/dev/null |
    sort -n | tail -n 1 | cut -d ' ' -f 2 || true)
  if [ -n "$newest" ]; then find "$newest" -type f; fi | pack "$output"
  ;;
*)
  sed -n 2,7p "$0"
  exit 2
  ;;
esac
