#!/bin/bash
# All benchmarks on a machine with an accelerator and no registry: its own Python and jax, wheels for the rest.
#   benchmarks/on_device.sh WHEEL_FOLDER OUTPUT_FOLDER
# Wheels it may lack: flax and what it needs, jaxtyping, tyro, safetensors, grain, optax, orbax, tqdm. Keep the run
# under 10 minutes: name the subjects to run as further arguments.
set -euo pipefail
wheels=$1 output=$2
shift 2
subjects=${*:-roofline crops network training scaling knn pose scenes}
cd "$(dirname "$0")/.."
site=$(mktemp -d)
python3 -m pip install --quiet --no-index --no-deps --no-compile --no-cache-dir --target "$site" "$wheels"/*.whl
export PYTHONPATH=$site PYTHONUNBUFFERED=1 XLA_PYTHON_CLIENT_PREALLOCATE=false
python3 -c 'import jax; print(jax.__version__, jax.devices())'
declare -A arguments=(
  [network]="--batches 1 4 16 64 --dense-up-to 4 --no-memory" [knn]="" [pose]="--draws 40"
  [scenes]="--batches 1 64 256" [training]="" [roofline]="" [scaling]="" [crops]="--batches 1 16 64 256"
)
for subject in $subjects; do
  # shellcheck disable=SC2086
  python3 -m "benchmarks.$subject" ${arguments[$subject]} --json "$output/$subject.json" 2>&1 | tee "$output/$subject.txt"
done
