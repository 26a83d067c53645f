#!/bin/sh
# Builds 02_render.c and draws a mesh, or the built-in scene:
#   sh examples/run.sh [mesh.obj|.ply|.stl] [options: --help lists them]
# CC chooses the compiler, TRBVH_OUT the folder for the program and the pictures (build/ in the project).
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
out=${TRBVH_OUT:-build}
case $out in /*) ;; *) out=$root/$out ;; esac

has() { command -v "$1" >/dev/null 2>&1; }
find_compiler() {
  compiler=${CC:-}
  for name in cc gcc clang; do         # not tcc: 0.9.27 loses floats next to calls that return structs
    if [ -z "$compiler" ] && has "$name"; then compiler=$name; fi
  done
  [ -n "$compiler" ]
}

if ! find_compiler && [ "$(id -u)" = 0 ] && has apt-get; then
  echo "no C compiler here: installing gcc and libc6-dev"
  export DEBIAN_FRONTEND=noninteractive
  log=$( { apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev; } 2>&1) || {
    printf '%s\n' "$log" >&2
  }
fi
if ! find_compiler; then
  echo "run.sh: no C compiler found: install gcc or clang, or set CC" >&2
  exit 1
fi

mkdir -p "$out"
$compiler -O3 "$root/examples/02_render.c" -o "$out/02_render" -lm -pthread
exec "$out/02_render" --out "$out/" "$@"
