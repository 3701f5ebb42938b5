#!/bin/bash
# Measures on a machine with an accelerator and no registry: its own Python and jax, wheels for the rest.
#   benchmarks/on_device.sh WHEELS CACHE OUTPUT [SUBJECT ...]
# WHEELS is a folder, or - where all is installed, so that this can be rehearsed; wheels that a machine may lack: flax
# and what it needs, jaxtyping, tyro, safetensors, grain, optax, orbax, tqdm. CACHE is the OUTPUT of the call before, or
# -: what was compiled there is not compiled again. OUTPUT gets results.tar.gz (JSON and tables, written anew after each
# subject, so that a call that is ended has what it did) and cache.tar.??, the newest compiled programs in pieces of
# 16 MB, at most MOST_PIECES: with the checkout and the wheels they must fit into what can be carried. A subject may
# take MINUTES at most. The first one is what was expected beside what is.
set -euo pipefail
wheels=$1 cache=$2 output=$3
shift 3
subjects=${*:-compiled network training knn pose scenes}  # crops, roofline and scaling need open3d, too large to carry
minutes=${MINUTES:-8} most=${MOST_PIECES:-1} target=${TARGET:-h200}
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mkdir -p "$output" "$work/results" "$work/cache"
if compgen -G "$cache/cache.tar.*" >/dev/null; then cat "$cache"/cache.tar.?? | tar x -C "$work/cache" || true; fi
if [ "$wheels" != - ]; then
  python3 -m pip install --quiet --no-index --no-deps --no-compile --no-cache-dir --target "$work/site" "$wheels"/*.whl
  export PYTHONPATH=$work/site
fi
export PYTHONUNBUFFERED=1 XLA_PYTHON_CLIENT_PREALLOCATE=false
export JAX_COMPILATION_CACHE_DIR=$work/cache JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=1
python3 -c 'import jax; print(jax.__version__, jax.devices())'
declare -A arguments=(
  [network]="--batches 1 4 16 64 --dense-up-to 4 --no-memory" [knn]="" [pose]="--draws 40"
  [scenes]="--batches 1 64 256" [training]="" [roofline]="" [scaling]="" [crops]="--batches 1 16 64 256"
  [compiled]="--target $target --measure"
)

pack() {
  tar cz -C "$work/results" -f "$work/results.tar.gz" . && mv "$work/results.tar.gz" "$output/results.tar.gz"
  # The newest programs first, as far as the pieces hold them: a program is used again or grows old.
  (cd "$work/cache" && find . -type f -printf '%T@ %s %p\n' | sort -rn |
    awk -v room="$((most * 15000000))" '{ used += $2 + 1024; if (used < room) print $3 }' | tar c -T - |
    split -b 16000000 - "$work/cache.tar.")
  rm -f "$output"/cache.tar.??
  if compgen -G "$work/cache.tar.??" >/dev/null; then mv "$work"/cache.tar.?? "$output"; fi
}

for subject in $subjects; do
  # shellcheck disable=SC2086
  timeout "$((60 * minutes))" python3 -m "benchmarks.$subject" ${arguments[$subject]} \
    --json "$work/results/$subject.json" 2>&1 | tee "$work/results/$subject.txt" ||
    echo "$subject did not end well" | tee -a "$work/results/$subject.txt"
  pack
done
