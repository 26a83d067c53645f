#!/bin/sh
# Builds and runs the tests, from any folder:
#   sh tests/run.sh                        everything
#   sh tests/run.sh test_build compile     only these
# On Debian and Ubuntu, when run by root, it first installs the tools that are missing. The last line is the sum:
# `N passed, N failed`. Environment:
#   CC, CFLAGS    when one is set, the test programs are compiled with them directly, without CMake
#   TRBVH_OUT     build folder, instead of build in the project's root; the tests are in its tests folder
here=$(cd "$(dirname "$0")" && pwd) || exit 1
root=$(cd "$here/.." && pwd)
out=${TRBVH_OUT:-build}
case $out in /*) ;; *) out=$root/$out ;; esac

have() { command -v "$1" >/dev/null 2>&1; }

# ---- tools -----------------------------------------------------------------------------------------------------------
missing_tools() {
  for tool in cmake make gcc g++ clang pkg-config; do
    have "$tool" || echo "$tool"
  done
}
missing_libraries() {
  [ -e /usr/include/stdio.h ] || echo libc6-dev
  ls /etc/OpenCL/vendors/*.icd >/dev/null 2>&1 || echo pocl-opencl-icd
  ls /usr/lib/*/libOpenCL.so.1 >/dev/null 2>&1 || echo ocl-icd-libopencl1
}
apt() { DEBIAN_FRONTEND=noninteractive apt-get -qq "$@" </dev/null >"$out/apt.log" 2>&1 || tail -n 5 "$out/apt.log"; }
install_packages() {
  if have apt-get && [ "$(id -u)" = 0 ]; then
    packages="$(missing_tools) $(missing_libraries)"
    if [ "$packages" != " " ]; then
      echo "installing:" $packages
      apt update
      for package in $packages; do   # one by one: without OpenCL, say, the rest still runs
        apt install -y --no-install-recommends "$package"
      done
    fi
  fi
  tools=$(missing_tools)
  [ ! "$tools" ] || echo "not installed:" $tools "(what needs them is left out)"
}

# ---- build -----------------------------------------------------------------------------------------------------------
compiler_flags() {   # of one test program, for a build without CMake
  case $1 in
    test_hooks | test_golden) echo -DTRBVH_THREADS ;;
    test_cl*) echo -rdynamic ;;                    # its stand-in for OpenCL is found in the program itself
  esac
}
build_directly() {
  jobs=0
  for name; do
    (${CC:-cc} ${CFLAGS--std=c99 -O2} $(compiler_flags "$name") -I"$root" "$here/$name.c" -o "$out/tests/$name" \
      -lm -pthread -ldl) >"$out/tests/$name.log" 2>&1 &
    jobs=$((jobs + 1))
    [ $((jobs % 2)) != 0 ] || wait
  done
  wait
  for name; do
    [ -x "$out/tests/$name" ] || cat "$out/tests/$name.log"
  done
}
build_with_cmake() {
  { cmake -S "$root" -B "$out/tests" -G "Unix Makefiles" -DTRBVH_BUILD_TESTS=ON -DTRBVH_BUILD_EXAMPLES=OFF &&
    cmake --build "$out/tests" --parallel 2 -- -k; } >"$out/tests/build.log" 2>&1 || cat "$out/tests/build.log"
}
build() {
  [ $# -gt 0 ] || return
  for name; do rm -f "$out/tests/$name"; done   # what does not build must not run
  if [ -z "${CC+set}${CFLAGS+set}" ] && have cmake && have make; then
    build_with_cmake
  else
    build_directly "$@"
  fi
}

# ---- run -------------------------------------------------------------------------------------------------------------
passed=0 failed=0

# run NAME COMMAND: prints its summary, and all of its output if something failed
limit=$(have timeout && echo timeout 900)
run() {
  name=$1
  shift
  $limit "$@" </dev/null >"$out/tests/$name.log" 2>&1
  status=$?
  summary=$(tail -n 1 "$out/tests/$name.log" | grep -E '^[0-9]+ passed, [0-9]+ failed$') || summary=
  good=${summary%% *} bad=${summary#*, }
  bad=${bad%% *}
  if [ "$status" = 127 ]; then
    good=0 bad=1 summary="was not built"
  elif [ ! "$summary" ]; then
    good=0 bad=1 summary="no summary, exit status $status"
  elif [ "$status" != 0 ] && [ "$bad" = 0 ]; then
    bad=1 summary="$summary, but exit status $status"
  fi
  if [ "$bad" != 0 ]; then cat "$out/tests/$name.log"; else grep '^left out' "$out/tests/$name.log"; fi
  echo "$name: $summary"
  passed=$((passed + good)) failed=$((failed + bad))
}

mkdir -p "$out/tests" || { echo "0 passed, 1 failed"; exit 1; }
install_packages

programs='' scripts=''
if [ $# = 0 ]; then
  for file in "$here"/test_*.c; do set -- "$@" "$(basename "$file" .c)"; done
  set -- "$@" compile consumer
fi
for name; do
  case $name in compile | consumer) scripts="$scripts $name" ;; *) programs="$programs $name" ;; esac
done
build $programs
for name in $programs; do run "$name" "$out/tests/$name"; done
for name in $scripts; do run "$name" sh "$here/$name/run.sh"; done

echo "$passed passed, $failed failed"
[ "$failed" = 0 ]
