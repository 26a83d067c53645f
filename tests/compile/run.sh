#!/bin/sh
# Compiles trbvh.h and trbvh_cl.h in every way a program may include them, and runs what comes out.
#   sh tests/compile/run.sh [c99] [two] [static] [macros] [cpp] [cl] [clpp] [core]     all of them when none is named
# Environment: CC, CFLAGS, CXX, CXXFLAGS, CLANG (for core).
here=$(cd "$(dirname "$0")" && pwd) || exit 1
tmp=$(mktemp -d) || exit 1
trap 'rm -rf "$tmp"' EXIT
passed=0 failed=0

have() { command -v "$1" >/dev/null 2>&1; }

# program NAME COMPILER FLAGS FILES: compile, link, run
program() {
  name=$1 compiler=$2 flags=$3
  shift 3
  have "$compiler" || { echo "left out: compile/$name ($compiler is not installed)"; return; }
  if (cd "$here" && $compiler $flags "$@" -o "$tmp/$name") && "$tmp/$name"; then
    passed=$((passed + 1))
  else
    echo "FAILED compile/$name: $compiler $flags $*"
    failed=$((failed + 1))
  fi
}

# program_cl NAME COMPILER FLAGS: trbvh_cl.h, its ways to be included
program_cl() {
  program "$1" "$2" "$3" cl.c $dl
  program "$1-without" "$2" "$3 -DTRBVH_NO_OPENCL" cl.c
  program "$1-static" "$2" "$3 -DTRBVH_STATIC" cl.c $dl
  [ -e /usr/include/CL/cl.h ] || return
  program "$1-header-before" "$2" "$3 -DCL_BEFORE" cl.c $dl
  program "$1-header-after" "$2" "$3 -DCL_AFTER" cl.c $dl
}

# Every file alone, in every shape it has.
syntax_of_core() {
  have "$clang" || { echo "left out: compile/core ($clang is not installed)"; return; }
  for file in "$here/core.cl" "$here"/../../kernels/*.cl; do
    for shape in TRB_CPU TRB_GPU; do
      if "$clang" -x cl -cl-std=CL1.2 -Xclang -finclude-default-header -fsyntax-only -Wall -Wextra -Wno-unused-parameter \
        -Wno-unused-function -Werror -I"$here/../.." -D$shape "$file"
      then passed=$((passed + 1))
      else echo "FAILED compile/core: $file, $shape"; failed=$((failed + 1))
      fi
    done
  done
}

cc=${CC:-cc} cxx=${CXX:-c++} clang=${CLANG:-clang}
cflags=${CFLAGS--std=c99 -O1 -Wall -Wextra -Wpedantic}
cxxflags=${CXXFLAGS--std=c++11 -O1 -Wall -Wextra -Wpedantic}

dl=
[ "$(uname)" != Linux ] || dl=-ldl      # for trbvh_cl.h, where glibc is old

[ $# -gt 0 ] || set -- c99 two static macros cpp cl clpp core
for item; do
  case $item in
    c99)    program c99    "$cc" "$cflags" c99.c ;;
    two)    program two    "$cc" "$cflags" two_a.c two_b.c ;;
    static) program static "$cc" "$cflags -Werror" static_a.c static_b.c ;;
    macros) program macros "$cc" "$cflags" macros.c ;;
    cpp)    program cpp    "$cxx" "$cxxflags" cpp.cpp ;;
    cl)     program_cl cl "$cc" "$cflags" ;;
    clpp)   program_cl clpp "$cxx" "$cxxflags -x c++" ;;
    core)   syntax_of_core ;;
    *)      echo "unknown: $item"; failed=$((failed + 1)) ;;
  esac
done
echo "$passed passed, $failed failed"
[ "$failed" = 0 ]
