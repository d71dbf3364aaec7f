#!/usr/bin/env bash
# All checks of docs/gpu-checks.md on a machine with a GPU that has torch with CUDA, and perhaps no network.
#
#   benchmarks/gpu_session.sh pack FOLDER                  where pip works: puts into FOLDER the wheels that it lacks
#   benchmarks/gpu_session.sh cut SEQUENCE N FOLDER        the first N frames of a TUM sequence, if less is to be carried
#   benchmarks/gpu_session.sh check FOLDER OUT [CHECK...]  there, in a checkout: installs the wheels, makes the checks,
#                                                          all or some; leaves in OUT a log of each, and checks.txt,
#                                                          and all of it in OUT.tar.gz
#
# SEQUENCE=FOLDER is a recording for the checks `tum` and `memory`, LIMIT=N its first frames, PATIENCE=S the seconds a
# check may take. Nothing of the other machine is changed: the wheels go to a folder of their own under /tmp.
set -uo pipefail
cd "$(dirname "$0")/.."

# What a machine with torch, numpy, scipy, numba, OpenCV, matplotlib, jaxtyping, rich, pytest and hypothesis lacks.
WHEELS=(gtsam tyro docstring-parser typeguard beartype gsplat)
PYTHON_THERE=${PYTHON_THERE:-3.12}

pack() {
    local folder=$1 platforms=()
    for glibc in 2_28 2_27 2_17; do platforms+=(--platform "manylinux_${glibc}_x86_64"); done
    mkdir -p "$folder"
    python3 -m pip download --quiet --no-deps --only-binary=:all: --python-version "$PYTHON_THERE" \
        --implementation cp "${platforms[@]}" --constraint constraints.txt --dest "$folder" "${WHEELS[@]}" &&
        python3 -m pip wheel --quiet --no-deps --wheel-dir "$folder" . && du -ch "$folder"/*.whl
}

cut() {
    local from=$1 frames=$2 to=$3 list
    for list in rgb depth; do
        mkdir -p "$to/$list"
        { grep '^#' "$from/$list.txt"; grep -v '^#' "$from/$list.txt" | head -n "$frames"; } > "$to/$list.txt"
        awk '!/^#/ { print $2 }' "$to/$list.txt" | (cd "$from" && xargs cp -t "$to/$list") || return
    done
    cp "$from"/*.toml "$from/groundtruth.txt" "$to"
}

installed() {
    SITE=$(mktemp -d /tmp/tcgsplat-site.XXXX)
    python3 -m pip install --quiet --no-index --no-deps --no-compile --no-cache-dir --target "$SITE" "$1"/*.whl &&
        export PYTHONPATH="$PWD/src:$SITE" PYTHONUNBUFFERED=1 OMP_WAIT_POLICY=passive
}

tcgsplat() { python3 -m tcgsplat.cli.main "$@"; }
sequence() { [[ -d ${SEQUENCE:-} ]] || { echo "no recording: set SEQUENCE to its folder"; return 3; }; }

check_doctor() { nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv; tcgsplat doctor; }
check_parity() { python3 -m pytest -p no:cacheprovider tests/parity -k "cuda and not emulated"; }
check_memcheck() { compute-sanitizer --tool memcheck python3 -m pytest -p no:cacheprovider tests/parity/test_cuda.py -k "cuda and not emulated"; }
check_tests() { python3 -m pytest -p no:cacheprovider tests/unit tests/regression -n 8; }
check_twice() {
    for name in one other; do tcgsplat demo --backend cuda --frames 120 --out "$WORK/$name" || return; done
    cmp "$WORK/one/run/map.ply" "$WORK/other/run/map.ply"
}
check_bench() { tcgsplat bench gpu --out "$OUT/bench"; }
check_iterations() { tcgsplat bench gpu --frames 0 --backends cuda --no-bare --out "$OUT/iterations"; }
check_beside() { tcgsplat bench gpu --frames 0 --out "$OUT/beside"; }  # gsplat, which compiles for minutes at first
check_sync() { python3 benchmarks/gpu_waits.py; }
check_demo() { tcgsplat demo --backend cuda --out "$WORK/demo" && cp "$WORK"/demo/run/{summary,report}.json "$OUT"; }
check_demo_cpu() { tcgsplat demo --backend numba --out "$WORK/demo-cpu"; }
check_gsplat() {  # compiled before the tests, each of which has only so much time
    python3 -c 'from tcgsplat.render.backends import open_rasterizer; open_rasterizer("gsplat")' &&
        python3 -m pytest -p no:cacheprovider tests/parity -k gsplat &&
        tcgsplat demo --backend gsplat --frames 120 --out "$WORK/demo-gsplat"
}
check_tum() {
    sequence || return
    for preset in default paper-tum; do
        tcgsplat run "$SEQUENCE" --preset $preset --backend cuda --limit "${LIMIT:-100000}" --out "$WORK/$preset" &&
            tcgsplat eval "$WORK/$preset" && cp "$WORK/$preset/report.json" "$OUT/$preset.json" || return
    done
    tcgsplat run "$SEQUENCE" --backend numba --limit "${LIMIT:-100000}" --out "$WORK/cpu" && tcgsplat eval "$WORK/cpu"
}
check_memory() {
    sequence || return
    tcgsplat run "$SEQUENCE" --preset paper-tum --backend cuda --max-gpu-memory 1 --limit 100 --out "$WORK/memory"
}

check() {
    local folder=$1 ended
    OUT=$2 WORK=$(mktemp -d /tmp/tcgsplat-work.XXXX)
    shift 2
    mkdir -p "$OUT" && OUT=$(cd "$OUT" && pwd) && installed "$folder" || return
    export OUT WORK PYTHONPATH
    export -f tcgsplat sequence
    for name in "${@:-doctor parity memcheck sync iterations demo demo_cpu twice tum memory gsplat beside}"; do
        for name in $name; do
            export -f "check_$name" || return
            SECONDS=0
            timeout "${PATIENCE:-600}" bash -c "check_$name" > "$OUT/$name.log" 2>&1
            ended=$?
            printf '%-12s exit code %3d  %4d s\n' "$name" $ended $SECONDS | tee -a "$OUT/checks.txt"
            tail -n 5 "$OUT/$name.log"
        done
    done
    tar -czf "$OUT.tar.gz" -C "$OUT" .
}

case ${1:-} in
    pack) pack "${2:?a folder for the wheels}" ;;
    cut) cut "$(realpath "${2:?a sequence}")" "${3:?how many frames}" "$(realpath -m "${4:?a folder}")" ;;
    check) check "${2:?the folder with the wheels}" "${3:?a folder for what comes out}" "${@:4}" ;;
    *) sed -n '2,13s/^# \?//p' "$0"; exit 2 ;;
esac
