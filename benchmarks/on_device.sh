#!/bin/bash
# All benchmarks on a machine with an accelerator and no registry: its own Python and jax, wheels for the rest.
#   benchmarks/on_device.sh WHEEL_FOLDER OUTPUT_FOLDER
# Wheels it may lack: flax and what it needs, jaxtyping, tyro, safetensors. Keep the run under 10 minutes.
set -euo pipefail
wheels=$1 output=$2
cd "$(dirname "$0")/.."
site=$(mktemp -d)
python3 -m pip install --quiet --no-index --no-deps --no-compile --no-cache-dir --target "$site" "$wheels"/*.whl
export PYTHONPATH=$site PYTHONUNBUFFERED=1 XLA_PYTHON_CLIENT_PREALLOCATE=false
python3 -c 'import jax; print(jax.__version__, jax.devices())'
python3 -m benchmarks.network --batches 1 4 16 64 --dense-up-to 4 --no-memory --json "$output/network.json" 2>&1 | tee "$output/network.txt"
python3 -m benchmarks.knn --json "$output/knn.json" 2>&1 | tee "$output/knn.txt"
python3 -m benchmarks.pose --draws 40 --json "$output/pose.json" 2>&1 | tee "$output/pose.txt"
python3 -m benchmarks.scenes --batches 1 64 256 --json "$output/scenes.json" 2>&1 | tee "$output/scenes.txt"
