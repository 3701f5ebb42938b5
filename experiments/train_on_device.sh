#!/bin/bash
# A slice of a training run on a machine with an accelerator and no registry.
#   experiments/train_on_device.sh WHEELS PIECES OUTPUT MINUTES CONFIG [--field value ...]
# OUTPUT gets the run's folder with its newest checkpoint as a tar file in pieces of 16 MB, of which 8 can be carried;
# PIECES is that folder of the slice before, or - to begin. WHEELS is a folder, or - where all is installed: so this can
# be rehearsed on a CPU. What was compiled lies in the run's folder too, so that the next slice begins at once. The pack
# must be there without its visibility bits, which are too large to carry: scenes are splatted.
set -euo pipefail
wheels=$1 pieces=$2 output=$3 minutes=$4 config=$5
shift 5
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mkdir -p "$output" "$work/run"
if [ "$pieces" != - ]; then cat "$pieces"/run.tar.?? | tar x -C "$work"; fi
if [ "$wheels" != - ]; then
  python3 -m pip install --quiet --no-index --no-deps --no-compile --no-cache-dir --target "$work/site" "$wheels"/*.whl
  export PYTHONPATH=$work/site
fi
export JAX_COMPILATION_CACHE_DIR=$work/run/compiled
PYTHONUNBUFFERED=1 python3 -m experiments.train "$config" --folder "$work/run" --resume --max-minutes "$minutes" \
  --examples.visibility splat "$@"
newest=$(cd "$work/run/checkpoints" && ls -dt step-* | head -n 1)
(cd "$work" && find run -type f ! -path "run/checkpoints/*" && find "run/checkpoints/$newest" -type f) |
  tar c -C "$work" -T - | split -b 16000000 - "$output/run.tar."
