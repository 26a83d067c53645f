#!/bin/sh
# Builds and runs the tests, from any folder:
#   sh tests/run.sh                        everything
#   sh tests/run.sh test_build compile     only these
# On Debian and Ubuntu, when run by root, it first installs the tools that are missing. The last line is the sum:
# `N passed, N failed`. Environment:
#   CC, CFLAGS    when one is set, the test programs are compiled with them directly, without CMake
#   TRBVH_OUT     build folder, instead of build in the project's root; the tests are in its tests folder
#   TRBVH_JOBS    how many programs are built, and then run, at a time: 2 when it is not set
here=$(cd "$(dirname "$0")" && pwd) || exit 1
root=$(cd "$here/.." && pwd)
out=${TRBVH_OUT:-build}
case $out in /*) ;; *) out=$root/$out ;; esac
jobs=${TRBVH_JOBS:-2}

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

# each COMMAND NAME ...: COMMAND with every name, a few at a time; prints the names as they end
each() {
  command=$1 lane=0
  shift
  rm -rf "$out/tests/taken"
  mkdir "$out/tests/taken"
  while [ "$lane" -lt "$jobs" ]; do
    lane=$((lane + 1))
    for name; do
      mkdir "$out/tests/taken/$name" 2>/dev/null || continue     # another lane has it
      "$command" "$name"
      echo "$name"
    done &
  done
  wait
}

# ---- build -----------------------------------------------------------------------------------------------------------
compiler_flags() {   # of one test program, for a build without CMake
  case $1 in
    test_hooks | test_golden) echo -DTRBVH_THREADS ;;
    test_cl*) echo -rdynamic ;;                    # its stand-in for OpenCL is found in the program itself
  esac
}
build_one() {
  ${CC:-cc} ${CFLAGS--std=c99 -O2} $(compiler_flags "$1") -I"$root" "$here/$1.c" -o "$out/tests/$1" \
    -lm -pthread -ldl >"$out/tests/$1.log" 2>&1
}
build_directly() {
  each build_one "$@" >/dev/null
  for name; do
    [ -x "$out/tests/$name" ] || cat "$out/tests/$name.log"
  done
}
build_with_cmake() {
  { cmake -S "$root" -B "$out/tests" -G "Unix Makefiles" -DTRBVH_BUILD_TESTS=ON -DTRBVH_BUILD_EXAMPLES=OFF &&
    cmake --build "$out/tests" --parallel "$jobs" -- -k; } >"$out/tests/build.log" 2>&1 || cat "$out/tests/build.log"
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
limit=$(have timeout && echo timeout 900)
run_one() {
  case $1 in
    compile | consumer) set -- "$1" sh "$here/$1/run.sh" ;;
    *) set -- "$1" "$out/tests/$1" ;;
  esac
  files=$out/tests/$1
  shift
  $limit "$@" </dev/null >"$files.log" 2>&1
  echo $? >"$files.status"
}

# report NAME: its summary, and all of its output if something failed
passed=0 failed=0
report() {
  log=$out/tests/$1.log status=none
  [ ! -e "$out/tests/$1.status" ] || status=$(cat "$out/tests/$1.status")
  summary=$(tail -n 1 "$log" | grep -E '^[0-9]+ passed, [0-9]+ failed$') || summary=
  good=${summary%% *} bad=${summary#*, }
  bad=${bad%% *}
  if [ "$status" = 127 ]; then
    good=0 bad=1 summary="was not built"
  elif [ ! "$summary" ]; then
    good=0 bad=1 summary="no summary, exit status $status"
  elif [ "$status" != 0 ] && [ "$bad" = 0 ]; then
    bad=1 summary="$summary, but exit status $status"
  fi
  if [ "$bad" != 0 ]; then cat "$log"; else grep '^left out' "$log"; fi
  echo "$1: $summary"
  passed=$((passed + good)) failed=$((failed + bad))
}
run_all() {   # several at a time, told of in the order of their names here
  for name; do rm -f "$out/tests/$name.status"; done
  each run_one "$@" | {
    ended=' '
    for name; do
      while case $ended in *" $name "*) false ;; esac && read -r one; do ended="$ended$one "; done
      report "$name"
    done
    echo "$passed passed, $failed failed"
    [ "$failed" = 0 ]
  }
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
run_all $scripts $programs   # compile is long, and must not be left over at the end
