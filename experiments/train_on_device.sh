#!/bin/bash
# A slice of a training run on a machine with an accelerator and no registry, from an exported run or from nothing.
#   experiments/train_on_device.sh WHEELS OUTPUT MINUTES CONFIG [--import FOLDER] [--field value ...]
# The pack must be there without its visibility bits, which are too large to carry: scenes are splatted. What to import
# next time, and the metrics, are in OUTPUT.
set -euo pipefail
wheels=$1 output=$2 minutes=$3 config=$4
shift 4
cd "$(dirname "$0")/.."
site=$(mktemp -d)
python3 -m pip install --quiet --no-index --no-deps --no-compile --no-cache-dir --target "$site" "$wheels"/*.whl
export PYTHONPATH=$site PYTHONUNBUFFERED=1
python3 -m experiments.train "$config" --folder "$output/run" --max-minutes "$minutes" --export "$output/export" \
  --examples.visibility splat "$@"
rm -rf "$output/run/checkpoints"
