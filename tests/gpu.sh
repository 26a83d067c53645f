#!/bin/sh
# Tests and measures the OpenCL backend on this machine's GPU, from any folder. It needs a C compiler and an OpenCL
# driver, and nothing else:
#   sh tests/gpu.sh [options] [mesh.ply ...]
# Options:
#   --device NAME   part of a device's or platform's name (the same as TRBVH_CL_DEVICE=NAME)
#   --small         20 and 200 thousand triangles instead of 1 and 10 million; on a CPU, with the kernels for CPUs and
#                   then with those for GPUs
#   --no-tests      only the benchmark
#   --csv FILE      all numbers of the tables, one a line
# Environment:
#   CC, CFLAGS      the compiler, and its options instead of -std=c99 -O2
#   TRBVH_OUT       build folder, instead of build in the project's root; programs and logs are in its gpu folder
# Exit status: 0 if all passed, 1 if not, or without an OpenCL device, 2 for errors of use.
here=$(cd "$(dirname "$0")" && pwd) || exit 1
root=$(cd "$here/.." && pwd)
out=${TRBVH_OUT:-build}
case $out in /*) ;; *) out=$root/$out ;; esac
out=$out/gpu

have() { command -v "$1" >/dev/null 2>&1; }
usage() {
  echo "gpu.sh: $1" >&2
  echo "usage: sh tests/gpu.sh [--device NAME] [--small] [--no-tests] [--csv FILE] [mesh.ply ...]" >&2
  exit 2
}

# ---- arguments -------------------------------------------------------------------------------------------------------
small='' tests=yes csv=''
arguments=$#
while [ "$arguments" -gt 0 ]; do       # what stays behind in "$@" are the meshes
  argument=$1
  shift
  arguments=$((arguments - 1))
  case $argument in
    --small) small=--small ;;
    --no-tests) tests='' ;;
    --device | --csv)
      [ "$arguments" -gt 0 ] || usage "$argument needs a value"
      if [ "$argument" = --csv ]; then csv=$1; else TRBVH_CL_DEVICE=$1; export TRBVH_CL_DEVICE; fi
      shift
      arguments=$((arguments - 1)) ;;
    -*) usage "there is no option $argument" ;;
    *)
      [ -r "$argument" ] || usage "$argument cannot be read"
      set -- "$@" "$argument" ;;
  esac
done
if [ "$csv" ]; then : >"$csv" || exit 2; fi        # every run of the benchmark appends

# ---- build -----------------------------------------------------------------------------------------------------------
compiler=${CC:-}
for name in cc gcc clang; do
  if [ ! "$compiler" ] && have "$name"; then compiler=$name; fi
done
[ "$compiler" ] || { echo "gpu.sh: no C compiler found: install gcc or clang, or set CC" >&2; exit 1; }
mkdir -p "$out" || exit 1

# build NAME SOURCE [option ...]: -rdynamic, so that the tests' stand-in for OpenCL is found; -ldl for an old glibc
build() {
  name=$1 source=$2
  shift 2
  rm -f "$out/$name"
  for dl in -ldl ''; do
    $compiler ${CFLAGS--std=c99 -O2} "$@" "$here/$source" -o "$out/$name" -lm -pthread $dl >"$out/$name.log" 2>&1 &&
      return
  done
  cat "$out/$name.log"
  echo "$name: was not built"
  return 1
}

# ---- device ----------------------------------------------------------------------------------------------------------
# finds LIBRARY: by the loader's list, or in the usual folders
finds() {
  { ldconfig -p || /sbin/ldconfig -p; } 2>/dev/null | grep -q "$1" && return
  for folder in /usr/lib /usr/lib64 /usr/lib/*-linux-* /usr/local/lib /usr/local/nvidia/lib64 /opt/rocm*/lib \
    /opt/amdgpu*/lib/*; do
    [ ! -e "$folder/$1" ] || return 0
  done
  return 1
}
hint() {
  [ "$(uname -s)" = Linux ] || return
  driver=''
  for library in libnvidia-opencl.so.1 libamdocl64.so libigdrcl.so; do
    if finds "$library"; then driver=$library; fi
  done
  if finds libOpenCL.so.1; then
    [ ! "$driver" ] || echo "The driver's $driver is there, though: see that a file in /etc/OpenCL/vendors names it."
  elif [ "$driver" ]; then
    echo "The driver's $driver is there, but the loader libOpenCL.so.1 is not: install it (ocl-icd-libopencl1 on"
    echo "Debian and Ubuntu, ocl-icd on Fedora and Arch), and see that a file in /etc/OpenCL/vendors names $driver."
  fi
}

echo "building with $compiler" >&2
build bench_cl bench_cl.c || exit 1
probe=$("$out/bench_cl" --probe) || { echo "${probe:-the benchmark does not run}"; hint; exit 1; }
shapes=own
case $probe in
  cpu*)
    [ "$small" ] && shapes='own gpu' || echo "${probe#* } is a CPU: --small is enough for a try" >&2 ;;
esac

# ---- tests -----------------------------------------------------------------------------------------------------------
failed=0 results=''
limit=$(have timeout && echo timeout 180)

# run_test NAME: its summary goes to results; all of its output is shown if something failed
run_test() {
  summary="was not built" rdynamic=''
  [ "$(uname -s)" != Linux ] || rdynamic=-rdynamic
  if build "$1" "$1.c" -UNDEBUG $rdynamic; then
    $limit "$out/$1" </dev/null >"$out/$1.log" 2>&1
    status=$?
    summary=$(tail -n 1 "$out/$1.log" | grep -E '^[0-9]+ passed, [0-9]+ failed$') || summary="no summary"
    if [ "$status" = 124 ] && [ "$limit" ]; then summary="stopped after ${limit#* } s"; fi
    case "$status $summary" in
      "0 "*" passed, 0 failed") summary="$summary  PASS" ;;
      *) summary="$summary, exit status $status  FAIL"; failed=1; cat "$out/$1.log" >&2 ;;
    esac
  else
    failed=1
  fi
  echo "$1: $summary" >&2
  results="$results$(printf '%-20s %s' "$1" "$summary")
"
}
if [ "$tests" ]; then
  run_test test_cl
  [ "$shapes" = own ] || run_test test_cl_gpu_shape
  run_test test_cl_wide_keys
fi

# ---- benchmark -------------------------------------------------------------------------------------------------------
version=$(awk '/^#define TRBVH_VERSION_(MAJOR|MINOR|PATCH) / { printf "%s%s", dot, $3; dot = "." }' "$root/trbvh.h")
echo "trbvh $version on OpenCL"
if [ "$tests" ]; then printf '\n%s' "$results"; fi
for shape in $shapes; do
  program=bench_cl
  if [ "$shape" = gpu ]; then
    program=bench_cl_gpu_shape
    build "$program" bench_cl.c -DTRB_CL_SHAPE=2 || { failed=1; continue; }
  fi
  echo
  "$out/$program" $small ${csv:+--csv "$csv"} "$@" || { failed=1; echo "$program: FAIL"; }
done
if [ "$failed" = 0 ]; then echo "all passed"; else echo "FAILED"; fi
exit "$failed"
