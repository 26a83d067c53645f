#!/bin/sh
# Builds 02_render.c and draws a mesh, or the built-in scene:
#   sh examples/run.sh [mesh.obj|.ply|.stl] [options: --help lists them]
# Then 03_opencl.c, with the same mesh, and 04_own_kernel.c, which say so where there is no OpenCL; and bench.c --quick.
# CC chooses the compiler, TRBVH_OUT the folder for the programs and the pictures (build/ in the project).
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
libraries="-lm -pthread"
if [ "$(uname)" = Linux ]; then libraries="$libraries -ldl"; fi   # its own library before glibc 2.34
for name in 02_render 03_opencl 04_own_kernel bench; do
  $compiler -O3 "$root/examples/$name.c" -o "$out/$name" $libraries
done
case " $* " in *" --help "*) exec "$out/02_render" --help ;; esac
mesh=
case ${1:-} in -*) ;; *) mesh=${1:-} ;; esac
"$out/02_render" --out "$out/" "$@"
echo
"$out/03_opencl" ${mesh:+"$mesh"}
echo
"$out/04_own_kernel" "$out/own_kernel.png"
echo
"$out/bench" --quick ${mesh:+"$mesh"}
