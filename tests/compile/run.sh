#!/bin/sh
# Compiles trbvh.h in every way a program may include it, and runs what comes out.
#   sh tests/compile/run.sh [c99] [two] [static] [macros] [cpp] [core]     all of them when none is named
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

syntax_of_core() {
  have "$clang" || { echo "left out: compile/core ($clang is not installed)"; return; }
  if "$clang" -x cl -cl-std=CL1.2 -Xclang -finclude-default-header -fsyntax-only -Wall -Wextra -Werror "$here/core.cl"
  then passed=$((passed + 1))
  else echo "FAILED compile/core"; failed=$((failed + 1))
  fi
}

cc=${CC:-cc} cxx=${CXX:-c++} clang=${CLANG:-clang}
cflags=${CFLAGS--std=c99 -O1 -Wall -Wextra -Wpedantic}
cxxflags=${CXXFLAGS--std=c++11 -O1 -Wall -Wextra -Wpedantic}

[ $# -gt 0 ] || set -- c99 two static macros cpp core
for item; do
  case $item in
    c99)    program c99    "$cc" "$cflags" c99.c ;;
    two)    program two    "$cc" "$cflags" two_a.c two_b.c ;;
    static) program static "$cc" "$cflags -Werror" static_a.c static_b.c ;;
    macros) program macros "$cc" "$cflags" macros.c ;;
    cpp)    program cpp    "$cxx" "$cxxflags" cpp.cpp ;;
    core)   syntax_of_core ;;
    *)      echo "unknown: $item"; failed=$((failed + 1)) ;;
  esac
done
echo "$passed passed, $failed failed"
[ "$failed" = 0 ]
